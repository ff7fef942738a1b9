"""Robustness map: where one arm brings the large square prism to its target, over starts, friction and mass, and speed.

Truth differs from what the controllers assume in the two quantities of each map; everything else is the shipped cell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

from touchcell.cell.experiments.push_measures import OBJECT
from touchcell.cell.experiments.pushing import COLUMNS, ERROR_NOTE, ONE_ARM, PRISMS, PUSH_HEIGHT_MM, push_measures
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.trials import Finished, Trial

_PRISM: Final = PRISMS[0]
_ROOM_MM: Final = 25.0
OFFSETS_MM: Final = (-30, -20, -10, 0, 10, 20, 30)
TURNS_DEG: Final = (-30, -15, 0, 15, 30)
FRICTIONS: Final = (0.15, 0.3, 0.45, 0.6)
MASSES_G: Final = (240, 479, 720, 960)
SPEEDS_MM_S: Final = (20, 50, 80, 100, 120)


def trials(scale: Scale) -> list[Trial]:
    """Return one trial for each point of the three maps; every second one for a quick look."""
    step = 2 if scale.quick else 1
    starts = [
        _trial(f"start_{y}_{turn}", "start", {"pose_offset_mm_deg": [_ROOM_MM - 20.0, y, 0, 0, 0, turn]})
        for y, turn in product(OFFSETS_MM[::step], TURNS_DEG[::step])
    ]
    loads = [
        _trial(f"load_{friction}_{mass}", "friction and mass", {"friction": friction, "mass_g": mass})
        for friction, mass in product(FRICTIONS[::step], MASSES_G[::step])
    ]
    speeds = [_trial(f"speed_{each}", "speed", {}, {"task.push_speed_mm_s": each}) for each in SPEEDS_MM_S[::step]]
    return [*starts, *loads, *speeds]


def _trial(name: str, row: str, truth: Mapping[str, Any], more: Mapping[str, Any] | None = None) -> Trial:
    changes: dict[str, Any] = ONE_ARM.around(_PRISM, "mdf", PUSH_HEIGHT_MM)
    x_mm, *rest = changes["arms.arm.start_pose_mm_deg"]
    section = {"shape": dict(_PRISM.shape), "mass_g": _PRISM.mass_g, "pose_mm_deg": [0, 0, 0, 0, 0, 0]}
    changes |= {
        "scene.physics": "quasi_static",
        "arms.arm.start_pose_mm_deg": [x_mm - _ROOM_MM, *rest],
        "scene.objects": {OBJECT: section},
        "truth": {"objects": {OBJECT: dict(truth)}},
        "seed": 1,
    }
    return Trial(name, row, ONE_ARM.cell, changes | dict(more or {}))


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Draw the maps: error of the object where it arrived, a cross where it did not."""
    from touchcell.cell.experiments.pushing_plots import plot_map

    by_name = {each.trial.name: each for each in finished}

    def errors(points: Sequence[Sequence[str]]) -> list[list[float]]:
        return [[_error_mm(by_name.get(name)) for name in row] for row in points]

    starts = errors([[f"start_{y}_{turn}" for y in OFFSETS_MM] for turn in TURNS_DEG])
    loads = errors([[f"load_{friction}_{mass}" for friction in FRICTIONS] for mass in MASSES_G])
    speeds = errors([[f"speed_{each}" for each in SPEEDS_MM_S]])
    return [
        plot_map(starts, OFFSETS_MM, TURNS_DEG, ("start, mm aside", "start, deg turned"), folder / "map_start.png"),
        plot_map(loads, FRICTIONS, MASSES_G, ("friction of the table", "mass, g"), folder / "map_load.png"),
        plot_map(speeds, SPEEDS_MM_S, (0,), ("speed, mm/s", ""), folder / "map_speed.png"),
    ]


def _error_mm(trial: Finished | None) -> float:
    return float("nan") if trial is None or not trial.done else trial.measures.get("object_error_mm", float("nan"))


SPEC = ExperimentSpec(
    name="push_map",
    summary="where one arm brings the large square prism to its target: maps over starts, friction and mass, speed",
    trials=trials,
    measure=push_measures,
    columns=COLUMNS,
    draw=draw,
    notes=(ERROR_NOTE,),
)
