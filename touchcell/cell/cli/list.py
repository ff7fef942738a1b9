"""What ``touchcell list`` shows: everything that a cell file may name, one line each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from touchcell import compiled
from touchcell.cell.bench.catalog import benchmark_names
from touchcell.cell.experiments.executors import EXECUTORS
from touchcell.cell.experiments.runner import EXPERIMENTS
from touchcell.control.interlocks.spec import INTERLOCKS
from touchcell.drivers.core.jog import HAND_DEVICES
from touchcell.drivers.core.spec import DRIVERS
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS
from touchcell.perception.models.architecture_spec import ARCHITECTURES
from touchcell.perception.networks.trainer import TRAINERS
from touchcell.perception.runtime.estimator_spec import ESTIMATORS
from touchcell.perception.runtime.feature_spec import FEATURES
from touchcell.perception.runtime.filter_spec import FILTERS
from touchcell.registry import Registry
from touchcell.simulation.shape_spec import OBJECTS, SURFACES
from touchcell.tasks.interface import TASKS
from touchcell.testing.emulation.launcher import EMULATORS


def listing() -> dict[str, list[tuple[str, str]]]:
    """Title -> rows of (name, one line). A third party's broken plug-in is shown as such instead of hiding the rest."""
    return {
        "drivers": _rows(DRIVERS),
        "input devices": _rows(HAND_DEVICES),
        "tasks": _rows(TASKS),
        "interlocks": [
            ("finite", "every number is finite; always on, checked first"),
            ("missing", "every arm and sensor is in the view; always on"),
            *_rows(INTERLOCKS),
        ],
        "estimators": _rows(ESTIMATORS),
        "architectures": _rows(ARCHITECTURES),
        "trainers": _rows(TRAINERS),
        "filters": _rows(FILTERS),
        "features": _rows(FEATURES),
        "surfaces": _rows(SURFACES),
        "objects": _rows(OBJECTS),
        "emulators": [(name, "") for name in EMULATORS.names()],
        "experiments": _rows(EXPERIMENTS),
        "executors": _rows(EXECUTORS),
        "benchmarks": [(name, "") for name in benchmark_names()],
        "cells that ship": [(f"configs/{path.name}", _first_comment(path)) for path in _shipped()],
    } | ({"missing": [(line, "") for line in lines]} if (lines := compiled.missing()) else {})


def _rows(registry: Registry[Any]) -> list[tuple[str, str]]:
    return [(name, _summary(registry, name)) for name in registry.names()]


def _summary(registry: Registry[Any], name: str) -> str:
    try:
        spec = registry.load(name)
    except ConfigError as error:
        return str(error)
    extra = getattr(spec, "extra", None)
    return f"{spec.summary}{f' [needs touchcell[{extra}]]' if extra else ''}"


def _shipped() -> list[Path]:
    return sorted(CONFIGS.glob("*.yaml"))


def _first_comment(path: Path) -> str:
    first = path.read_text().partition("\n")[0]
    return first.removeprefix("# ") if first.startswith("#") else ""
