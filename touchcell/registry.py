"""Find plug-ins by name: entry points that lead to a spec, imported only when one is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, Generic, NoReturn, TypeVar

from touchcell.errors import ConfigError, suggest

SpecT = TypeVar("SpecT")


@dataclass(frozen=True, slots=True)
class Registry(Generic[SpecT]):
    """All installed plug-ins of one kind.

    Attributes:
        group: entry-point group, e.g. "touchcell.drivers".
        noun: what one of them is called in messages, and the key that names it in a cell file, e.g. "driver".
        spec_type: what an entry point has to lead to: a class, or a runtime-checkable Protocol.
    """

    group: str
    noun: str
    spec_type: type[SpecT]

    def names(self) -> tuple[str, ...]:
        """Names of all plug-ins, sorted. Imports none of them."""
        return tuple(sorted(_points(self.group)))

    def load(self, name: str) -> SpecT:
        """Import plug-in ``name`` and return its spec.

        Raises:
            ConfigError: there is no such plug-in (with a suggestion), several distributions claim the name, or its
                entry point cannot be imported, leads to something else, or to a spec of another name.
        """
        found = _points(self.group).get(name, ())
        if not found:
            raise ConfigError(
                f"unknown {self.noun} {name!r}",
                key=self.noun,
                value=name,
                hint=suggest(name, self.names(), otherwise=f"known {self.noun}s"),
            )
        if len(found) > 1:
            self._refuse(
                f"{self.noun} {name!r} is claimed by {' and by '.join(map(_origin, found))}",
                name,
                "uninstall all but one of them",
            )
        (point,) = found
        try:
            spec = point.load()
        except Exception as error:  # A stranger's module may raise anything while it is imported.
            self._refuse(
                f"{_origin(point)} cannot be imported: {type(error).__name__}: {error}",
                name,
                f"repair or uninstall {_distribution(point)}",
                error,
            )
        if not isinstance(spec, self.spec_type):
            self._refuse(
                f"{_origin(point)} leads to a {type(spec).__name__}, not to a {self.spec_type.__name__}",
                name,
                f"point it at the {self.spec_type.__name__} of its module",
            )
        if getattr(spec, "name", name) != name:
            self._refuse(
                f"{_origin(point)} leads to the {self.spec_type.__name__} of {spec.name!r}",  # type: ignore[attr-defined]
                name,
                "give entry point and spec one name",
            )
        return spec

    def _refuse(self, reason: str, name: str, hint: str, cause: Exception | None = None) -> NoReturn:
        raise ConfigError(reason, key=self.noun, value=name, hint=hint) from cause


def _distribution(point: EntryPoint) -> str:
    return "an unknown distribution" if point.dist is None else f"{point.dist.name} {point.dist.version}"


def _origin(point: EntryPoint) -> str:
    return f"entry point {point.name} = {point.value!r} of {_distribution(point)}"


@cache
def _points(group: str) -> Mapping[str, Sequence[EntryPoint]]:
    found: dict[str, list[EntryPoint]] = {}
    for point in _everywhere().select(group=group):
        found.setdefault(point.name, []).append(point)
    return MappingProxyType(found)


@cache
def _everywhere() -> Any:
    # Reading what every installed package declares takes 15 ms, and does not change while a process runs. Python 3.11
    # and 3.12 differ in the type; both have `select`.
    return entry_points()
