"""YAML with a memory of lines, so that every complaint names file, line, key, value and remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from touchcell.errors import ConfigError, suggest

KeyPath = tuple[str | int, ...]
M = TypeVar("M", bound=BaseModel)


class InvalidCell(ConfigError):
    """A cell file with one or more mistakes; ``problems`` has one ConfigError each."""

    def __init__(self, problems: Sequence[ConfigError]) -> None:
        first = problems[0]
        super().__init__(
            first.reason, file=first.file, line=first.line, key=first.key, value=first.value, hint=first.hint
        )
        self.problems = tuple(problems)

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.problems)


@dataclass(frozen=True, slots=True)
class YamlFile:
    """A parsed file: its data, and the line on which each key stands."""

    path: Path
    data: dict[str, Any]
    lines: Mapping[KeyPath, int]

    def line(self, path: KeyPath) -> int:
        """Line of the key, or of the nearest thing around it that stands in the file."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)

    def problem(self, path: KeyPath, reason: str, *, value: Any = None, hint: str = "") -> ConfigError:
        """A ConfigError about the key at ``path``."""
        key = ".".join(str(part) for part in path)
        return ConfigError(reason, file=str(self.path), line=self.line(path), key=key, value=value, hint=hint)

    def validate(self, model: type[M], data: Any, at: KeyPath = ()) -> M:
        """Build ``model`` from ``data``, which stands at ``at``. Raises InvalidCell with every mistake."""
        try:
            return model.model_validate(data)
        except ValidationError as error:
            raise InvalidCell([self._explain(model, at, dict(detail)) for detail in error.errors()]) from None

    def _explain(self, model: type[BaseModel], at: KeyPath, detail: dict[str, Any]) -> ConfigError:
        location: KeyPath = detail["loc"]
        path = self._written(at, location)
        value = detail.get("input")
        kind = detail["type"]
        if kind == "extra_forbidden":
            known = _fields_at(model, location[:-1])
            return self.problem(path, "unknown key", value=value, hint=suggest(str(location[-1]), known))
        if kind == "missing":
            return self.problem(path, "is missing", hint=f"add `{location[-1]}:`")
        reason = detail["msg"].removeprefix("Value error, ")
        shown = "" if isinstance(value, dict | list) else f", not {value!r}"
        return self.problem(path, reason[:1].lower() + reason[1:] + shown, value=value)

    def _written(self, at: KeyPath, location: KeyPath) -> KeyPath:
        """``location`` without the union tags that pydantic puts in and nobody wrote."""
        path = at
        for part in location[:-1]:
            if (*path, part) in self.lines:
                path = (*path, part)
        return path + location[-1:]


def _fields_at(model: type[BaseModel], location: KeyPath) -> list[str]:
    """Field names of the model that ``location`` leads to, through fields, indices and union tags."""
    candidates = [model]
    for part in location:
        fields = [c.model_fields[str(part)] for c in candidates if str(part) in c.model_fields]
        tagged = [c for c in candidates if _has_tag(c, part)]
        if fields:
            candidates = [m for field in fields for m in _models_in(field.annotation)] or candidates
        elif tagged:
            candidates = tagged
    return sorted({name for candidate in candidates for name in candidate.model_fields})


def _has_tag(model: type[BaseModel], tag: str | int) -> bool:
    return any(tag in get_args(field.annotation) for field in model.model_fields.values())


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]


def load(path: Path) -> YamlFile:
    """Read ``path``. Raises ConfigError for what cannot be read, is no YAML, or repeats a key."""
    try:
        text = path.read_text()
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}", file=str(path), hint="`touchcell list` names the cells that ship"
        ) from None
    try:
        # The loader in C, where it was built, is ten times as fast: 40 ms of a cell's start.
        node = yaml.compose(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        loader = yaml.SafeLoader("")
        lines: dict[KeyPath, int] = {(): 1}
        if not isinstance(node, yaml.MappingNode):
            raise ConfigError("is no mapping", file=str(path), line=1, hint="a cell file starts with `schema: 1`")
        _walk(node, (), lines, str(path))
        data: dict[str, Any] = loader.construct_document(node)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = mark.line + 1 if mark else 0
        raise ConfigError(f"is no YAML: {getattr(error, 'problem', error)}", file=str(path), line=line) from None
    return YamlFile(path, data, lines)


def _walk(node: yaml.Node, path: KeyPath, lines: dict[KeyPath, int], file: str) -> None:
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            key = (*path, key_node.value)
            line = key_node.start_mark.line + 1
            if key in lines:
                raise ConfigError(
                    f"stands twice, first on line {lines[key]}", file=file, line=line, key=".".join(map(str, key))
                )
            lines[key] = line
            _walk(value_node, key, lines, file)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[*path, index] = item.start_mark.line + 1
            _walk(item, (*path, index), lines, file)
