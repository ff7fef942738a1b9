"""Finding plug-ins by name: entry points that lead to a spec, loaded only when asked for."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from touchcell.errors import ConfigError, suggest

S = TypeVar("S")


def installed(group: str) -> dict[str, EntryPoint]:
    """Entry points of ``group`` by name; nothing is imported."""
    return {point.name: point for point in _everywhere().select(group=group)}


@cache
def _everywhere() -> Any:
    # Reading what every installed package declares takes 15 ms, and does not change while a process runs. Python 3.11
    # and 3.12 differ in the type; both have `select`.
    return entry_points()


def load(group: str, word: str, name: str, kind: type[S]) -> S:
    """The spec that entry point ``name`` of ``group`` leads to.

    Args:
        group: entry-point group, e.g. "touchcell.drivers".
        word: what people call its members and the key they write in the cell file, e.g. "driver".
        name: the one that is wanted.
        kind: type of the spec.

    Raises:
        ConfigError: the name is unknown (with a suggestion), or its entry point leads to something else.
    """
    points = installed(group)
    if name not in points:
        raise ConfigError(
            f"unknown {word} {name!r}", key=word, value=name, hint=suggest(name, points, otherwise=f"known {word}s")
        )
    found = points[name].load()
    if not isinstance(found, kind):
        raise ConfigError(
            f"entry point {points[name].value!r} is no {kind.__name__}",
            key=name,
            value=points[name].value,
            hint="point it at the module's SPEC",
        )
    return found
