"""What ``touchcell list`` shows: everything that a cell file may name, one line each."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

from touchcell import compiled
from touchcell import registry as entry_points
from touchcell.cell.bench.catalog import benchmarks
from touchcell.control.interlocks.config import INTERLOCKS
from touchcell.drivers.core import spec as drivers_registry
from touchcell.paths import CONFIGS
from touchcell.tasks import registry as tasks_registry


def listing() -> dict[str, list[tuple[str, str]]]:
    """Title -> rows of (name, one line). A third party's broken plug-in is shown as such instead of hiding the rest."""
    return {
        "drivers": [(name, _summary(point)) for name, point in sorted(drivers_registry.installed().items())],
        "tasks": [(name, _summary(point)) for name, point in sorted(tasks_registry.installed().items())],
        "interlocks": [(spec.kind, spec.summary) for spec in INTERLOCKS.values()],
        "emulators": [(name, "") for name in sorted(entry_points.installed("touchcell.emulators"))],
        "experiments": [
            (name, _summary(point)) for name, point in sorted(entry_points.installed("touchcell.experiments").items())
        ],
        "benchmarks": [(name, "") for name in sorted(benchmarks())],
        "cells that ship": [(f"configs/{path.name}", _first_comment(path)) for path in _shipped()],
    } | ({"missing": [(line, "") for line in lines]} if (lines := compiled.missing()) else {})


def _summary(point: EntryPoint) -> str:
    try:
        spec = point.load()
    except Exception as error:
        return f"cannot be loaded: {error!r}"
    extra = getattr(spec, "extra", None)
    return f"{spec.summary}{f' [needs touchcell[{extra}]]' if extra else ''}"


def _shipped() -> list[Path]:
    return sorted(CONFIGS.glob("*.yaml"))


def _first_comment(path: Path) -> str:
    first = path.read_text().partition("\n")[0]
    return first.removeprefix("# ") if first.startswith("#") else ""
