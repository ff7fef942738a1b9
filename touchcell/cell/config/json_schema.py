"""A JSON Schema (draft 2020-12) of cell files, from everything that is installed.

Editors complete and check cell files by it. What a schema cannot express (that devices and task fit, that margins are
large enough) stays with ``touchcell check``. Keys that the command line may give (``data``) are not required, and of a
file that extends another nothing is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, JsonSchemaValue, models_json_schema
from pydantic_core import core_schema

from touchcell.cell.config.cell_plan import CellFile
from touchcell.cell.config.meanings import meanings, summary
from touchcell.drivers.core.scene import scene_section
from touchcell.drivers.core.spec import DRIVERS
from touchcell.registry import Registry
from touchcell.tasks.interface import TASKS

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_FROM_THE_COMMAND_LINE: Final = "data"
_OPEN_SECTIONS: Final[Mapping[str, tuple[str, Registry[Any]]]] = {
    "ArmSection": ("driver", DRIVERS),
    "SensorSection": ("driver", DRIVERS),
    "DeviceSection": ("driver", DRIVERS),
    "TaskSection": ("name", TASKS),
}
"""Section -> the key that names a plug-in, whose other keys stand in the section too."""


class WithMeanings(GenerateJsonSchema):
    """Adds what the docstrings say to what pydantic knows."""

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        """Return the schema of a model, each key with its meaning."""
        found = super().model_schema(schema)
        model: type[BaseModel] = schema["cls"]
        if text := summary(model):
            found["description"] = text
        for name, meaning in meanings(model).items():
            key = model.model_fields[name].alias or name
            if (entry := found.get("properties", {}).get(key)) is not None:
                entry["description"] = meaning
        return found


def cell_schema() -> dict[str, Any]:
    """Return the schema of cell files. Raises ConfigError where an installed plug-in is broken."""
    scene = scene_section()
    plugins = {
        registry.group: {name: registry.load(name).config for name in registry.names()} for registry in (DRIVERS, TASKS)
    }
    models: list[type[BaseModel]] = [
        CellFile,
        scene,
        *(model for found in plugins.values() for model in found.values()),
    ]
    inputs: list[tuple[type[BaseModel], JsonSchemaMode]] = [(model, "validation") for model in models]
    references, document = models_json_schema(inputs, schema_generator=WithMeanings)
    at = {model: reference["$ref"].rpartition("/")[2] for (model, _), reference in references.items()}
    definitions: dict[str, Any] = document["$defs"]
    for section, (tag, registry) in _OPEN_SECTIONS.items():
        _open(definitions, section, tag, {name: at[model] for name, model in plugins[registry.group].items()})
    _name_by_steps(definitions["TaskSection"], at[plugins[TASKS.group]["steps"]])
    for definition in definitions.values():
        _relax(definition)
    cell = definitions[at[CellFile]]
    for key in ("scene", "emulated_scene"):
        cell["properties"][key] = {
            "$ref": f"#/$defs/{at[scene]}",
            "description": cell["properties"][key]["description"],
        }
    cell["properties"]["extends"] = {"type": "string", "description": "cell file that this one builds on."}
    cell["patternProperties"] = {"^x-": {"description": "holds YAML anchors; not read."}}
    return {
        "$schema": DIALECT,
        "title": "touchcell cell file",
        "if": {"required": ["extends"]},
        "then": {"type": "object"},
        "else": {"$ref": f"#/$defs/{at[CellFile]}"},
        "$defs": definitions,
    }


def _open(definitions: dict[str, Any], section: str, tag: str, plugins: Mapping[str, str]) -> None:
    """Let the plug-in that ``tag`` names say which other keys the section has."""
    found = definitions[section]
    found.pop("additionalProperties", None)
    found["properties"][tag] = {**found["properties"][tag], "enum": sorted(plugins)}
    found["allOf"] = []
    for name, definition in plugins.items():
        # Its own keys stand beside the section's, which its model does not know.
        definitions[definition].pop("additionalProperties", None)
        names_it = {"properties": {tag: {"const": name}}, "required": [tag]}
        found["allOf"].append({"if": names_it, "then": {"$ref": f"#/$defs/{definition}"}})
    found["unevaluatedProperties"] = False


def _name_by_steps(task: dict[str, Any], steps: str) -> None:
    """A task that has ``steps`` need not say that it is called so."""
    task["required"] = []
    task["anyOf"] = [{"required": ["name"]}, {"required": ["steps"]}]
    unnamed = {"not": {"required": ["name"]}}
    task["allOf"].append({"if": unnamed, "then": {"$ref": f"#/$defs/{steps}"}})


def _relax(definition: Any) -> None:
    """Do not require what the command line may give."""
    if isinstance(definition, dict):
        if isinstance(required := definition.get("required"), list) and _FROM_THE_COMMAND_LINE in required:
            definition["required"] = [key for key in required if key != _FROM_THE_COMMAND_LINE]
        for value in definition.values():
            _relax(value)
    elif isinstance(definition, list):
        for value in definition:
            _relax(value)
