"""Sections of a cell file that a plug-in validates: one key names the plug-in, the others are the plug-in's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, PydanticKnownError, core_schema

from touchcell.errors import ConfigError
from touchcell.registry import Registry

PLUGIN: Final = "x-plugin"
"""Keyword of a JSON Schema that says which kind of plug-in a section belongs to."""


class Section(BaseModel):
    """Base of a plug-in's section: unknown keys are refused, values are frozen and finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class HasConfig(Protocol):
    """Any spec whose plug-in has a section in a cell file."""

    @property
    def config(self) -> type[BaseModel]:
        """Pydantic model of the section, including the key that names the plug-in."""
        ...


@dataclass(frozen=True, slots=True)
class PluginSection:
    """Annotation of a field that holds the section of a plug-in: ``Annotated[BaseOfItsConfig, PluginSection(...)]``.

    The plug-in is imported when a section names it, so that a file costs only what it uses.

    Attributes:
        registry: of the plug-ins.
        tag: key that names the plug-in.
        default: plug-in of a section without that key; None if the key is required.
        nested: the section is one within a plug-in of the same kind: schemas name its plug-in and leave its keys out,
            which would contain themselves.
    """

    registry: Registry[Any]
    tag: str = "kind"
    default: str | None = None
    nested: bool = False

    def model_of(self, section: Mapping[str, Any]) -> type[BaseModel]:
        """Return the model of ``section``. Raises ConfigError for a plug-in that does not exist or is broken."""
        spec: HasConfig = self.registry.load(str(section.get(self.tag, self.default)))
        return spec.config

    def _validate(self, value: Any) -> BaseModel:
        if isinstance(value, BaseModel):
            return value
        if not isinstance(value, Mapping):
            raise PydanticKnownError("dict_type")
        if self.tag not in value and self.default is None:
            raise PydanticCustomError(
                "plugin_missing", "names no {noun}", {"noun": self.registry.noun, "tag": self.tag}
            )
        try:
            model = self.model_of(value)
        except ConfigError as error:
            context = {"tag": self.tag, "reason": error.reason, "hint": error.hint, "value": error.value}
            raise PydanticCustomError("plugin", "{reason} ({hint})", context) from error
        return model.model_validate(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self._validate,
            serialization=core_schema.plain_serializer_function_ser_schema(BaseModel.model_dump),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        if self.nested:
            tag = {"type": "string", "enum": list(self.registry.names())}
            return {"type": "object", "properties": {self.tag: tag}, "required": [self.tag]}
        models = [self.registry.load(name).config for name in self.registry.names()]
        for model in models:
            model.model_rebuild()
        union = handler(core_schema.union_schema([model.__pydantic_core_schema__ for model in models]))
        return union | {PLUGIN: self.registry.noun}
