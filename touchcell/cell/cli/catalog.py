"""Everything that a cell file may hold: every kind of thing, every key, with unit, default, limits and meaning.

Made from the models of what is installed, so it knows a stranger's plug-in as well as ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from pydantic import BaseModel

from touchcell.cell.config import cell_plan
from touchcell.cell.config.json_schema import WithMeanings
from touchcell.cell.config.meanings import summary
from touchcell.cell.config.truth import TruthSection
from touchcell.control.interlocks.spec import INTERLOCKS
from touchcell.drivers.core.scene import scene_section
from touchcell.drivers.core.spec import DRIVERS
from touchcell.errors import ConfigError, suggest
from touchcell.perception.models.architecture_spec import ARCHITECTURES
from touchcell.perception.networks.trainer import TRAINERS
from touchcell.perception.runtime.estimator_spec import ESTIMATORS
from touchcell.perception.runtime.filter_spec import FILTERS
from touchcell.plugin_section import PLUGIN
from touchcell.registry import Registry
from touchcell.simulation.shape_spec import OBJECTS, SURFACES
from touchcell.tasks.interface import TASKS
from touchcell.units import unit_of

_REGISTRIES: Final[Mapping[str, Registry[Any]]] = {
    "driver": DRIVERS,
    "task": TASKS,
    "interlock": INTERLOCKS,
    "estimator": ESTIMATORS,
    "architecture": ARCHITECTURES,
    "trainer": TRAINERS,
    "filter": FILTERS,
    "surface": SURFACES,
    "object": OBJECTS,
}
_SECTIONS: Final[Mapping[str, type[BaseModel]]] = {
    "file": cell_plan.CellFile,
    "arm": cell_plan.ArmSection,
    "sensor": cell_plan.SensorSection,
    "device": cell_plan.DeviceSection,
    "task": cell_plan.TaskSection,
    "obstacle": cell_plan.BoxSection,
    "pair": cell_plan.PairSection,
    "recording": cell_plan.RecordingSection,
    "collect": cell_plan.CollectSection,
    "truth": TruthSection,
}
SECTION: Final = "section"
KINDS: Final = (SECTION, *_REGISTRIES)
"""What can be described: sections of the cell file, and every kind of plug-in that has keys there."""

_LIMITS: Final = {
    "exclusiveMinimum": "> {}",
    "minimum": ">= {}",
    "exclusiveMaximum": "< {}",
    "maximum": "<= {}",
    "multipleOf": "multiple of {}",
    "minLength": "at least {} characters",
    "pattern": "matches {}",
}


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a cell file.

    Attributes:
        name: dotted inside a section; ``[]`` stands for the items of a list, ``*`` for names of one's own.
        type: what its value is.
        unit: of the value; "" for none.
        default: value of a file that leaves it out, as in YAML; None if it is required.
        limits: of the value; "" for none.
        meaning: one or two sentences.
    """

    name: str
    type: str
    unit: str
    default: str | None
    limits: str
    meaning: str


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing that a cell file may name.

    Attributes:
        kind: one of ``KINDS``.
        name: as in the cell file.
        summary: one line.
        text: more about it; may be empty.
        keys: its keys.
    """

    kind: str
    name: str
    summary: str
    text: str
    keys: tuple[Key, ...]


def names(kind: str) -> tuple[str, ...]:
    """Return the names of everything of a kind. Raises ConfigError for an unknown kind."""
    if kind == SECTION:
        return (*_SECTIONS, "scene")
    if kind not in _REGISTRIES:
        raise ConfigError(
            f"unknown kind {kind!r}", key="KIND", value=kind, hint=suggest(kind, KINDS, otherwise="kinds")
        )
    return _REGISTRIES[kind].names()


def describe(kind: str, name: str) -> Entry:
    """Describe one thing. Raises ConfigError for an unknown kind or name, or a broken plug-in."""
    known = names(kind)
    if kind == SECTION:
        if name not in known:
            raise ConfigError(f"unknown section {name!r}", key="NAME", value=name, hint=suggest(name, known))
        model = scene_section() if name == "scene" else _SECTIONS[name]
        first, _, rest = summary(model).partition("\n\n")
        return Entry(kind, name, " ".join(first.split()), rest, tuple(keys_of(model)))
    spec = _REGISTRIES[kind].load(name)
    model = spec.config
    return Entry(kind, name, spec.summary, summary(model), tuple(keys_of(model)))


def keys_of(model: type[BaseModel]) -> Iterator[Key]:
    """Yield the keys of a model, with those of the sections inside it."""
    document = model.model_json_schema(schema_generator=WithMeanings)
    yield from _keys(document, document.get("$defs", {}), "", ())


def _keys(
    section: Mapping[str, Any], definitions: Mapping[str, Any], prefix: str, above: tuple[str, ...]
) -> Iterator[Key]:
    required = section.get("required", ())
    for name, entry in section.get("properties", {}).items():
        limits = ", ".join(_limits(entry, definitions))
        default = None if name in required else _shown(entry.get("default"))
        meaning = str(entry.get("description", ""))
        yield Key(prefix + name, _type(entry, definitions), unit_of(name), default, limits, meaning)
        for mark, reference in _sections(entry):
            if reference not in above:
                inner = definitions[reference]
                yield from _keys(inner, definitions, f"{prefix}{name}{mark}.", (*above, reference))


def _sections(entry: Mapping[str, Any], mark: str = "") -> Iterator[tuple[str, str]]:
    """Yield the names of the sections that a value is made of, with the mark of items of a list or mapping.

    Sections of plug-ins are left out: they are described as kinds of their own.
    """
    if PLUGIN in entry:
        return
    if "$ref" in entry:
        yield mark, entry["$ref"].rpartition("/")[2]
    for choice in (*entry.get("anyOf", ()), *entry.get("oneOf", ()), *entry.get("allOf", ())):
        yield from _sections(choice, mark)
    if isinstance(items := entry.get("items"), Mapping):
        yield from _sections(items, f"{mark}[]")
    if isinstance(values := entry.get("additionalProperties"), Mapping):
        yield from _sections(values, f"{mark}.*")


def _type(entry: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if PLUGIN in entry:
        return f"section of {_an(entry[PLUGIN])}"
    if "$ref" in entry:
        found = definitions[entry["$ref"].rpartition("/")[2]]
        return _type(found, definitions) if "enum" in found else "section"
    if "const" in entry:
        return str(entry["const"])
    if "enum" in entry:
        return " | ".join(str(choice) for choice in entry["enum"])
    if choices := entry.get("anyOf") or entry.get("oneOf"):
        types = dict.fromkeys(_type(choice, definitions) for choice in choices if choice.get("type") != "null")
        return " or ".join(types)
    kind = str(entry.get("type", "anything"))
    if kind == "array":
        if "prefixItems" in entry:
            return f"list of {len(entry['prefixItems'])} {_type(entry['prefixItems'][0], definitions)}s"
        return f"list of {_type(entry.get('items', {}), definitions)}s"
    if kind == "object":
        values = entry.get("additionalProperties")
        return f"mapping of names to {_type(values, definitions)}" if isinstance(values, Mapping) else "section"
    return {"integer": "whole number", "string": "text", "boolean": "true | false"}.get(kind, kind)


def _limits(entry: Mapping[str, Any], definitions: Mapping[str, Any]) -> Iterator[str]:
    for key, text in _LIMITS.items():
        if key in entry:
            yield text.format(entry[key])
    for choice in (*entry.get("anyOf", ()), *entry.get("prefixItems", ())[:1]):
        yield from _limits(choice, definitions)


def _shown(default: Any) -> str:
    """A default as it would be written in a cell file."""
    import yaml

    if default is None:
        return "none"
    text: str = yaml.safe_dump(default, default_flow_style=True, width=10**6)
    return text.strip().removesuffix("...").strip()


def _an(noun: str) -> str:
    return f"an {noun}" if noun[0] in "aeiou" else f"a {noun}"
