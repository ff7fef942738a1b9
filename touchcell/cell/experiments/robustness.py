"""Robustness: one arm and two push the large square prism while one condition at a time is degraded.

A cell has to tolerate 30 % of friction and mass and 20 ms of latency; the other conditions are increased until it
fails.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from touchcell.cell.experiments.pushing import (
    COLUMNS,
    ERROR_NOTE,
    ONE_ARM,
    PRISMS,
    PUSH_HEIGHT_MM,
    TWO_ARMS,
    Arms,
    push_measures,
    row_trials,
)
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.trials import Finished, Trial

_ARMS = (ONE_ARM, TWO_ARMS)
_MDF = 0.3
_TIP = 0.9
_PRISM = PRISMS[0]

# A * stands for every sensor of the cell.
CHANGES: Mapping[str, Mapping[str, Any]] = {
    "as it is": {},
    "camera noise x 2": {"sensors.*.noise": 4.0},
    "camera noise x 8": {"sensors.*.noise": 16.0},
    "camera noise x 16": {"sensors.*.noise": 32.0},
    "exposure x 0.7": {"sensors.*.exposure": 0.7},
    "blur 2 px": {"sensors.*.blur_px": 2.0},
    "1 of 10 frames lost": {"sensors.*.dropped": 0.1},
    "1 of 3 frames lost": {"sensors.*.dropped": 1.0 / 3.0},
    "2 of 3 frames lost": {"sensors.*.dropped": 2.0 / 3.0},
    "latency + 20 ms": {"sensors.*.latency_ms": 30.0},
    "latency + 50 ms": {"sensors.*.latency_ms": 60.0},
    "latency + 90 ms": {"sensors.*.latency_ms": 100.0},
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
    """Return trials of every change with one arm and with two, from the same few starts."""
    return [
        trial
        for arms in _ARMS
        for what, changes in CHANGES.items()
        if not scale.quick or what in _QUICK
        for trial in row_trials(
            f"{what}, {arms.name}",
            arms.cell,
            _PRISM,
            arms.around(_PRISM, "mdf", PUSH_HEIGHT_MM) | _for_every_sensor(changes, arms),
            scale.repetitions(3),
        )
    ]


def _for_every_sensor(changes: Mapping[str, Any], arms: Arms) -> dict[str, Any]:
    return {key.replace("*", sensor): value for key, value in changes.items() for sensor in arms.sensors}


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot every trial's error by changed condition; one figure for one arm and one for two."""
    from touchcell.cell.experiments.pushing_plots import plot_errors

    return [
        plot_errors(shown, folder / f"errors_{arms.name.replace(' ', '_')}.png")
        for arms in _ARMS
        if (shown := [each for each in finished if each.trial.row.endswith(arms.name)])
    ]


SPEC = ExperimentSpec(
    name="robustness",
    summary="one arm and two push the large square prism, with one condition at a time degraded",
    trials=trials,
    measure=push_measures,
    columns=COLUMNS,
    draw=draw,
    notes=(ERROR_NOTE,),
)
