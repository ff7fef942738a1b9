"""Robustness: single-arm pushing of the large square prism while one thing after another is made worse.

Friction and mass by 30 % and latency by 20 ms are what a cell has to stand; the rest goes on until it breaks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cell.experiment import ExperimentSpec, Scale
from cell.experiments.pushing import (
    COLUMNS,
    ERROR_NOTE,
    PRISMS,
    PUSH_HEIGHT_MM,
    leader_changes,
    object_changes,
    push_measures,
    starts,
)
from cell.run_folder import RunFolder
from cell.trials import Finished, Trial

SENSOR = "sensor"
CELL = "single_push_sim.yaml"
_MDF = 0.3
_TIP = 0.9
_PRISM = PRISMS[0]

CHANGES: Mapping[str, Mapping[str, Any]] = {
    "as it is": {},
    "camera noise x 2": {f"sensors.{SENSOR}.noise": 4.0},
    "camera noise x 8": {f"sensors.{SENSOR}.noise": 16.0},
    "camera noise x 16": {f"sensors.{SENSOR}.noise": 32.0},
    "exposure x 0.7": {f"sensors.{SENSOR}.exposure": 0.7},
    "blur 2 px": {f"sensors.{SENSOR}.blur_px": 2.0},
    "1 of 10 frames lost": {f"sensors.{SENSOR}.dropped": 0.1},
    "1 of 3 frames lost": {f"sensors.{SENSOR}.dropped": 1.0 / 3.0},
    "2 of 3 frames lost": {f"sensors.{SENSOR}.dropped": 2.0 / 3.0},
    "latency + 20 ms": {f"sensors.{SENSOR}.latency_ms": 30.0},
    "latency + 50 ms": {f"sensors.{SENSOR}.latency_ms": 60.0},
    "latency + 90 ms": {f"sensors.{SENSOR}.latency_ms": 100.0},
    "table friction - 30 %": {"scene.table.friction": 0.7 * _MDF},
    "table friction + 30 %": {"scene.table.friction": 1.3 * _MDF},
    "table friction x 4": {"scene.table.friction": 4.0 * _MDF},
    "tip friction - 30 %": {"scene.tip.friction": 0.7 * _TIP},
    "tip friction + 30 %": {"scene.tip.friction": 1.3 * _TIP},
    "tip friction / 5": {"scene.tip.friction": 0.2 * _TIP},
    "mass - 30 %": {"scene.objects.prism.mass_g": 0.7 * _PRISM.mass_g},
    "mass + 30 %": {"scene.objects.prism.mass_g": 1.3 * _PRISM.mass_g},
    "mass x 5": {"scene.objects.prism.mass_g": 5.0 * _PRISM.mass_g},
}
_QUICK = (
    "as it is",
    "camera noise x 8",
    "1 of 3 frames lost",
    "latency + 20 ms",
    "table friction + 30 %",
    "mass + 30 %",
)


def trials(scale: Scale) -> list[Trial]:
    """Every change, from the same few starts."""
    found = []
    for row, changes in CHANGES.items():
        if scale.quick and row not in _QUICK:
            continue
        for seed, pose in starts(scale.repetitions(3)):
            whole = leader_changes(_PRISM, "mdf", "arm", PUSH_HEIGHT_MM) | object_changes(_PRISM, pose) | dict(changes)
            found.append(Trial(f"{_slug(row)}_{seed}", row, CELL, whole | {"seed": seed}))
    return found


def _slug(row: str) -> str:
    words = row.translate({ord("+"): "more", ord("-"): "less", ord("/"): "by", ord("%"): ""}).split()
    return "_".join(words)


def measure(run: RunFolder) -> Mapping[str, float]:
    """See ``pushing.push_measures``."""
    return push_measures(run, SENSOR)


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Every trial's error, by what was made worse."""
    from cell.experiments.pushing_plots import plot_errors

    return [plot_errors(finished, folder / "errors.png", aim_mm=2.0)]


SPEC = ExperimentSpec(
    name="robustness",
    summary="single-arm pushing of the large square prism, with one thing after another made worse",
    trials=trials,
    measure=measure,
    columns=COLUMNS,
    draw=draw,
    notes=(ERROR_NOTE,),
)
