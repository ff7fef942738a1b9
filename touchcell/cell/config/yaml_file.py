"""YAML with a memory of lines, so that every problem names file, line, key, value and remedy.

Files come from people and from scripts: encodings, aliases, nesting, tags and sizes that none needs are refused.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from touchcell.errors import ConfigError, suggest
from touchcell.plugin_section import PluginSection

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
    """A parsed file: its data, and the line on which each key stands.

    Attributes:
        path: the file.
        data: its content.
        lines: line of each key.
        sources: file or option that each key comes from, where it is not ``path`` (see ``layers``).
    """

    path: Path
    data: dict[str, Any]
    lines: Mapping[KeyPath, int]
    sources: Mapping[KeyPath, Path] = field(default_factory=dict)

    def source(self, path: KeyPath) -> Path:
        """Return the file or option that the key comes from."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.sources.get(path, self.path)

    def line(self, path: KeyPath) -> int:
        """Line of the key, or of the nearest thing around it that stands in the file."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)

    def problem(self, path: KeyPath, reason: str, *, value: Any = None, hint: str = "") -> ConfigError:
        """A ConfigError about the key at ``path``."""
        key = ".".join(str(part) for part in path)
        return ConfigError(reason, file=str(self.source(path)), line=self.line(path), key=key, value=value, hint=hint)

    def validate(self, model: type[M], data: Any, at: KeyPath = ()) -> M:
        """Build ``model`` from ``data``, which stands at ``at``. Raises InvalidCell with every mistake.

        Text is never taken for a number or a boolean, nor a boolean for a number.
        """
        try:
            built = model.model_validate(data)
        except ValidationError as error:
            details = [dict(detail) for detail in error.errors()]
            raise InvalidCell([self._explain(model, data, at, detail) for detail in _merged(details)]) from None
        wrong = [
            self.problem(path, f"must be {_WANTED[type(made)]}, not {_short(found)}", value=found)
            for path, found, made in _converted(data, built, at)
        ]
        if wrong:
            raise InvalidCell(wrong)
        return built

    def _explain(self, model: type[BaseModel], data: Any, at: KeyPath, detail: dict[str, Any]) -> ConfigError:
        location: KeyPath = detail["loc"]
        path = (*at, *_written(data, location))
        value = detail.get("input")
        kind = detail["type"]
        context = detail.get("ctx", {})
        if kind == "extra_forbidden":
            return self._unknown_key(path, str(location[-1]), _models_at(model, location[:-1], data), value)
        if kind == "missing":
            written = "schema: 1" if location == ("schema",) else f"{location[-1]}:"
            return self.problem((*path, location[-1]), "is missing", hint=f"add `{written}`")
        if kind == "count":
            wanted = _NUMBERS.get(context["wanted"], str(context["wanted"]))
            meaning = next((words for ending, words in _MEANINGS if str(path[-1]).endswith(ending)), "")
            return self.problem(path, f"needs {wanted} numbers{meaning}, found {context['found']}", value=value)
        if kind == "plugin":
            return self.problem(
                (*path, context["tag"]), context["reason"], value=context["value"], hint=context["hint"]
            )
        if kind == "plugin_missing":
            return self.problem((*path, context["tag"]), "is missing", hint=f"add `{context['tag']}:`")
        if kind == "union_tag_invalid":
            tag = str(context["discriminator"]).strip("'")
            names = re.findall(r"'([^']*)'", str(context["expected_tags"]))
            unknown = str(context["tag"])
            return self.problem((*path, tag), f"unknown {tag} {unknown!r}", value=unknown, hint=suggest(unknown, names))
        if kind == "union_tag_not_found":
            tag = str(context["discriminator"]).strip("'")
            return self.problem((*path, tag), "is missing", hint=f"add `{tag}:`")
        if kind in ("too_short", "too_long"):
            least = kind == "too_short"
            wanted = context["min_length" if least else "max_length"]
            return self.problem(
                path,
                f"needs at {'least' if least else 'most'} {wanted}, found {context['actual_length']}",
                value=value,
                hint="add one" if least else "leave out the others",
            )
        if value is None and kind != "value_error":
            return self.problem(path, "has no value", hint="write one behind the colon, or leave the key out")
        reason = detail["msg"].removeprefix("Value error, ")
        reason = reason.replace("Input should be", "must be").replace("valid dictionary", "mapping")
        reason = reason.replace("a valid tuple", "a list").replace("a valid list", "a list")
        reason = re.sub(r" or instance of \w+", " of keys", reason)
        reason = re.sub(
            r"^Unable to parse input string as an? (\w+), exceeded maximum size", r"must be a valid \1", reason
        )
        reason = re.sub(r", unable to (parse|interpret) .*", "", reason)
        shown = "" if isinstance(value, dict | list) else f", not {_short(value)}"
        hint = "write it in quotes" if kind == "string_type" and isinstance(value, int | float | bool) else ""
        if reason.endswith("must be a mapping of keys"):
            hint = "write its keys and values below it"
        return self.problem(path, reason[:1].lower() + reason[1:] + shown, value=value, hint=hint)

    def _unknown_key(self, path: KeyPath, key: str, models: Sequence[type[BaseModel]], value: Any) -> ConfigError:
        for each in models:
            if (new := getattr(each, "renamed_keys", {}).get(key)) is not None:
                return self.problem(path, "was renamed", value=value, hint=f"write `{new}:`")
        known = {field.alias or name for each in models for name, field in each.model_fields.items()}
        return self.problem(path, "unknown key", value=value, hint=suggest(key, known))


def _written(data: Any, location: KeyPath) -> KeyPath:
    """``location`` as far as it is in ``data``: without the union tags that pydantic puts in."""
    path: KeyPath = ()
    for part in location:
        in_list = isinstance(data, list | tuple) and isinstance(part, int) and part < len(data)
        if in_list or (isinstance(data, dict) and part in data):
            data = data[part]
            path = (*path, part)
    return path


_A_NUMBER: Final = "must be a valid integer"
_NUMBERS: Final = {2: "two", 3: "three", 4: "four", 6: "six", 7: "seven"}
_MEANINGS: Final = (("_mm_deg", " [x y z mm, rx ry rz deg]"), ("_mm", " [x y z]"))


def _short(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."


_WANTED: Final = {bool: "a boolean, true or false", int: "a valid integer", float: "a valid number"}


def _converted(data: Any, made: Any, at: KeyPath) -> Iterator[tuple[KeyPath, Any, Any]]:
    """Places where pydantic made a number of text or of a boolean, or a boolean of text: it takes "yes" for true."""
    if isinstance(made, BaseModel) and isinstance(data, dict):
        names = {field.alias or name: name for name, field in type(made).model_fields.items()}
        if len(data) == 1 and not names.keys() & data.keys():
            # A section that is wrapped in its own name, as a task's step.
            ((key, inner),) = data.items()
            yield from _converted(inner, made, (*at, key))
        for key in names.keys() & data.keys():
            yield from _converted(data[key], getattr(made, names[key]), (*at, key))
    elif isinstance(made, Mapping) and isinstance(data, dict):
        for key in made.keys() & data.keys():
            yield from _converted(data[key], made[key], (*at, key))
    elif isinstance(made, list | tuple) and isinstance(data, list | tuple):
        for index, (inner, value) in enumerate(zip(data, made, strict=False)):
            yield from _converted(inner, value, (*at, index))
    elif type(made) in _WANTED and isinstance(data, str | bool) and type(data) is not type(made):
        yield at, data, made


def _merged(details: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mistakes with those about one list's length as one, of the type "count"."""
    found: dict[KeyPath, dict[str, Any]] = {}
    for detail in details:
        at: KeyPath = detail["loc"]
        kind = detail["type"]
        if kind == "missing" and at and isinstance(at[-1], int):
            have = detail["input"]
            known = found.get(at[:-1])
            wanted = at[-1] + 1
            if known is None or known["type"] != "count":
                count = {"wanted": wanted, "found": len(have)}
                found[at[:-1]] = detail | {"loc": at[:-1], "type": "count", "ctx": count}
            else:
                known["ctx"]["wanted"] = wanted
        elif kind == "too_long" and isinstance(detail["input"], list):
            limits = detail["ctx"]
            found[at] = detail | {
                "type": "count",
                "ctx": {"wanted": limits["max_length"], "found": limits["actual_length"]},
            }
        else:
            found.setdefault((*at, kind), detail)
    return list(found.values())


def _models_at(model: type[BaseModel], location: KeyPath, data: Any) -> list[type[BaseModel]]:
    """Models that ``location`` leads to in ``data``, through fields, indices, tags and plug-ins."""
    candidates: list[type[BaseModel] | PluginSection] = [model]
    for part in location:
        models = _resolved(candidates, data)
        fields = [each.model_fields[str(part)] for each in models if str(part) in each.model_fields]
        tagged = [each for each in models if _has_tag(each, part)]
        if fields:
            candidates = [m for field in fields for m in _models_in(field)] or candidates
        elif tagged:
            candidates = [*tagged]
        data = _child(data, part)
    return _resolved(candidates, data)


def _resolved(candidates: Sequence[type[BaseModel] | PluginSection], data: Any) -> list[type[BaseModel]]:
    """``candidates`` with the model that ``data`` asks for in place of a section, once the section is reached."""
    models = []
    for each in candidates:
        if not isinstance(each, PluginSection):
            models.append(each)
        elif isinstance(data, Mapping) and isinstance(data.get(each.tag, each.default), str):
            models.append(each.model_of(data))
    return models


def _child(data: Any, part: str | int) -> Any:
    try:
        return data[part]
    except (KeyError, IndexError, TypeError):
        # A union tag, which is not in the file.
        return data


def _has_tag(model: type[BaseModel], tag: str | int) -> bool:
    return any(tag in get_args(field.annotation) for field in model.model_fields.values())


def _models_in(annotation: Any) -> list[type[BaseModel] | PluginSection]:
    """Models and plug-ins' sections in an annotation or a field."""
    if isinstance(annotation, FieldInfo):
        sections = [each for each in annotation.metadata if isinstance(each, PluginSection)]
        return [*sections] or _models_in(annotation.annotation)
    if isinstance(annotation, PluginSection):
        return [annotation]
    arguments = get_args(annotation)
    if any(isinstance(each, PluginSection) for each in arguments):
        return [each for each in arguments if isinstance(each, PluginSection)]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in arguments for model in _models_in(argument)]


def load(path: Path) -> YamlFile:
    """Read a cell file.

    YAML 1.2's core scalars only: ``yes``, ``on``, ``1:30``, ``012``, ``1_000`` and dates are text.

    Raises:
        ConfigError: for what cannot be read, is no text in UTF-8, no YAML, repeats a key, or grows beyond bounds.
    """
    text = _read_text(path)
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if not isinstance(node, yaml.MappingNode):
            raise ConfigError("is no mapping", file=str(path), line=1, hint="a cell file starts with `schema: 1`")
        walk = _Walk(str(path), loader)
        walk.visit(node, (), ())
        data: dict[str, Any] = loader.construct_document(node)
    except yaml.YAMLError as error:
        raise _syntax_error(path, text, error) from None
    except RecursionError:
        # Only the loader in Python, which has no bound of its own.
        raise ConfigError(_TOO_DEEP, file=str(path), hint=_TOO_DEEP_HINT) from None
    finally:
        loader.dispose()
    return YamlFile(path, data, walk.lines)


def parse_value(text: str) -> Any:
    """Return the value that ``text`` has in a cell file. Raises ConfigError if it is no YAML."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _Walk("", loader).visit(node, (), ())
        return loader.construct_document(node)
    except yaml.YAMLError as error:
        reason = getattr(error, "problem", None) or "is no YAML"
        raise ConfigError(str(reason), value=text, hint="quote what is not a number, list or mapping") from None
    except RecursionError:
        raise ConfigError(_TOO_DEEP, value=text, hint=_TOO_DEEP_HINT) from None
    finally:
        loader.dispose()


_MOST_BYTES: Final = 256 * 1024
_MOST_NODES: Final = 20_000
_MOST_CHARACTERS: Final = 1_000_000
_DEEPEST: Final = 40
_LARGEST: Final = 1e9
# Infinity and NaN are refused where a number is needed.
_NO_NUMBER: Final = re.compile(r"[-+]?\.[a-zA-Z]")
_TOO_DEEP: Final = f"is nested more than {_DEEPEST} levels deep"
_TOO_DEEP_HINT: Final = "no section of a cell file needs that"
# What people save by mistake, by its first bytes.
_FOREIGN: Final = {
    b"\x1f\x8b": ("is compressed by gzip", "unpack it with `gunzip`"),
    b"PK\x03\x04": ("is a ZIP archive", "unpack it with `unzip`"),
    b"\x89MCAP0": ("is an MCAP recording", "name the cell file, not the recording"),
    b"\xff\xfe": ("is text in UTF-16", "save it as UTF-8"),
    b"\xfe\xff": ("is text in UTF-16", "save it as UTF-8"),
}


def _read_text(path: Path) -> str:
    hint = "`touchcell list` names the cells that ship"
    if "\x00" in str(path):
        raise ConfigError("cannot be the name of a file", file=repr(str(path)), hint=hint)
    try:
        # A pipe without a writer must not block.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as stream:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise ConfigError("is no regular file", file=str(path), hint=hint)
            content = stream.read(_MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=str(path), hint=hint) from None
    for start, (reason, remedy) in _FOREIGN.items():
        if content.startswith(start):
            raise ConfigError(reason, file=str(path), line=1, hint=remedy)
    if len(content) > _MOST_BYTES:
        raise ConfigError(
            f"is longer than {_MOST_BYTES // 1024} KiB", file=str(path), line=1, hint="a cell file has a few kilobytes"
        )
    if b"\x00" in content:
        raise ConfigError(
            "is binary, or text in UTF-16 or UTF-32", file=str(path), line=1, hint="a cell file is YAML text in UTF-8"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start]
        raise ConfigError(
            f"is no text in UTF-8: byte 0x{byte:02x}, {bytes([byte]).decode('latin-1')!r} in Latin-1",
            file=str(path),
            line=line,
            hint="save it as UTF-8, as by `iconv -f latin1 -t utf8`",
        ) from None


def _syntax_error(path: Path, text: str, error: yaml.YAMLError) -> ConfigError:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    if isinstance(error, yaml.reader.ReaderError):
        # Its position is in bytes or characters, by loader.
        bad = next((i for i, each in enumerate(text) if yaml.reader.Reader.NON_PRINTABLE.match(each)), 0)
        line = text.count("\n", 0, bad) + 1
        return ConfigError(f"holds the control character {text[bad]!r}", file=str(path), line=line, hint="delete it")
    line = mark.line + 1 if mark else 0
    lines = text.splitlines()
    blamed = lines[line - 1] if 0 < line <= len(lines) else ""
    if "\t" in blamed[: len(blamed) - len(blamed.lstrip())]:
        return ConfigError("is indented by a tab", file=str(path), line=line, hint="use spaces")
    problem = str(getattr(error, "problem", None) or "cannot be parsed")
    if "nesting depth" in problem:
        return ConfigError(_TOO_DEEP, file=str(path), line=line, hint=_TOO_DEEP_HINT)
    hint = "use spaces in place of tabs" if "\t" in blamed else _SYNTAX_HINTS.get(problem, "")
    return ConfigError(f"is no YAML: {problem}", file=str(path), line=line, hint=hint)


_SYNTAX_HINTS: Final = {
    "mapping values are not allowed in this context": "check the indentation, or quote text that has `: ` in it",
    "could not find expected ':'": "a key is followed by `: ` and its value",
    "did not find expected key": "check the indentation, and that each `{`, `[` and quote is closed",
    "did not find expected ',' or '}'": "close the `{`",
    "did not find expected ',' or ']'": "close the `[`",
    "expected a single document in the stream": "leave out the second `---`",
}

_TAG: Final = "tag:yaml.org,2002:"
_STRING: Final = f"{_TAG}str"
_FLOAT: Final = f"{_TAG}float"
_MERGE: Final = f"{_TAG}merge"


# The loader in C, where it was built, is ten times as fast: 40 ms of a cell's start.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """PyYAML's safe loader with the scalars of YAML 1.2: nothing else than a number, true, false or null is no text."""

    yaml_implicit_resolvers: ClassVar[dict[str | None, list[Any]]] = {}


for _name, _pattern, _first in (
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    # More than 18 digits are no number that a cell needs, and thousands take minutes to convert.
    ("int", r"^(?:[-+]?(?:0|[1-9][0-9]{0,17})|0x[0-9a-fA-F]{1,15})$", list("-+0123456789")),
    (
        "float",
        r"^(?:[-+]?(?:(?:0|[1-9][0-9]{0,39})?\.[0-9]{1,40}|(?:0|[1-9][0-9]{0,39})\.?)(?:[eE][-+]?[0-9]{1,4})?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        list("-+.0123456789"),
    ),
    ("merge", r"^<<$", ["<"]),
):
    _Loader.add_implicit_resolver(f"{_TAG}{_name}", re.compile(_pattern), _first)


class _Walk:
    """Walks a parsed document with its aliases expanded: finds lines, and refuses what no cell file needs.

    Args:
        file: for errors.
        loader: resolves plain scalars.
    """

    def __init__(self, file: str, loader: Any) -> None:
        self._file = file
        self._loader = loader
        self._nodes = 0
        self._characters = 0
        self.lines: dict[KeyPath, int] = {(): 1}

    def visit(self, node: yaml.Node, path: KeyPath, above: tuple[int, ...]) -> None:
        """Walk ``node``, which stands at ``path`` below the nodes ``above``. Raises ConfigError."""
        if id(node) in above:
            raise self._error(node, path, "refers to itself", "write out what is meant in place of the alias")
        if len(above) >= _DEEPEST:
            raise self._error(node, path, _TOO_DEEP, _TOO_DEEP_HINT)
        self._count(node, path)
        if isinstance(node, yaml.MappingNode):
            self._tagged(node, path, "map")
            for key_node, value_node in node.value:
                key = (*path, self._key(key_node, path))
                line = key_node.start_mark.line + 1
                if key in self.lines:
                    raise self._error(key_node, key, f"stands twice, first on line {self.lines[key]}", "remove one")
                self.lines[key] = line
                self.visit(value_node, key, (*above, id(node)))
        elif isinstance(node, yaml.SequenceNode):
            self._tagged(node, path, "seq")
            for index, item in enumerate(node.value):
                self.lines[*path, index] = item.start_mark.line + 1
                self.visit(item, (*path, index), (*above, id(node)))
        elif node.tag not in (_STRING, self._loader.resolve(yaml.ScalarNode, node.value, (True, False))):
            raise self._error(node, path, f"has the tag {node.tag.replace(_TAG, '!!')!r}", "leave it out")
        elif node.tag == _FLOAT and not _NO_NUMBER.match(node.value) and abs(float(node.value)) > _LARGEST:
            reason = f"{node.value} is larger than any length, speed, rate or time of a cell, {_LARGEST:g}"
            raise self._error(node, path, reason, "check its unit")

    def _key(self, node: yaml.Node, path: KeyPath) -> str:
        self._count(node, path)
        if isinstance(node, yaml.ScalarNode) and node.tag in (_STRING, _MERGE):
            return str(node.value)
        if isinstance(node, yaml.ScalarNode):
            shown = str(node.value)[:40]
            raise self._error(node, path, f"the key {shown!r} is no text", f"write it in quotes: '{shown}':")
        raise self._error(node, path, "a key is a list or a mapping", "a key is a word")

    def _tagged(self, node: yaml.Node, path: KeyPath, kind: str) -> None:
        if node.tag != f"{_TAG}{kind}":
            raise self._error(node, path, f"has the tag {node.tag.replace(_TAG, '!!')!r}", "leave it out")

    def _count(self, node: yaml.Node, path: KeyPath) -> None:
        self._nodes += 1
        if isinstance(node, yaml.ScalarNode):
            self._characters += len(node.value)
        if self._nodes > _MOST_NODES or self._characters > _MOST_CHARACTERS:
            raise self._error(
                node,
                path[:1],
                f"holds more than {_MOST_NODES} values or {_MOST_CHARACTERS} characters, its aliases expanded",
                "leave out aliases of aliases",
            )

    def _error(self, node: yaml.Node, path: KeyPath, reason: str, hint: str) -> ConfigError:
        key = ".".join(map(str, path))
        return ConfigError(reason, file=self._file, line=node.start_mark.line + 1, key=key, hint=hint)
