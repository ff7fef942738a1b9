"""Common parts of the pushing experiments: the paper's objects, the start of a trial, and the measures at its end.

The paper states masses but not sizes, and that the sensor is 45 mm above the table. Sizes here follow from its masses
at one density: squares of 80 and 60 mm, a circle of 80 mm and a hexagon of 70 mm across flats, all 80 mm high.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from touchcell.cell.analysis.push_errors import push_errors
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.experiments.push_measures import OBJECT, lean_deg
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished, Trial

SURFACES = ("mdf", "foam")
PUSH_HEIGHT_MM = 45.0
_HEIGHT_MM = 80.0
_GAP_MM = 5.0
_TIP_MM = 20.0
# Placement error of an object that is positioned by hand.
_OFFSET_MM, _TURN_DEG = 3.0, 2.0

ESTIMATORS: Mapping[str, Mapping[str, Any] | None] = {"learned": None, "true contact": {"kind": "true_contact"}}
"""Estimator sections by their name in rows; None for the cell file's own."""


COLUMNS = (
    Column("error_mm", "error mm", below=2.0),
    Column("error_mm", "worst", "worst"),
    Column("object_error_mm", "object mm"),
    Column("object_error_mm", "worst", "worst"),
    Column("lean_max_deg", "lean deg", "worst"),
)
ERROR_NOTE = "error: distance of the target from the true contact normal at the end of the push, in top view"


@dataclass(frozen=True, slots=True)
class Pushed:
    """An object that is pushed.

    Attributes:
        name: name in the paper.
        shape: of the cell file's ``scene.objects``.
        mass_g: its mass.
        reach_mm: distance from its centre to the contact.
    """

    name: str
    shape: Mapping[str, Any]
    mass_g: float
    reach_mm: float

    def taller(self, height_mm: float, mass_g: float) -> Pushed:
        """Return an object of the same outline with that height."""
        tall = dict(self.shape)
        if "size_mm" in tall:
            tall["size_mm"] = [*tall["size_mm"][:2], height_mm]
        else:
            tall["height_mm"] = height_mm
        return Pushed(f"tall {self.name}", tall, mass_g, self.reach_mm)


PRISMS = (
    Pushed("large square", {"kind": "box", "size_mm": [80, 80, _HEIGHT_MM]}, 479, 40),
    Pushed("circular", {"kind": "cylinder", "diameter_mm": 80, "height_mm": _HEIGHT_MM}, 363, 40),
    Pushed("small square", {"kind": "box", "size_mm": [60, 60, _HEIGHT_MM]}, 264, 30),
    Pushed("hexagonal", {"kind": "hexagon", "width_mm": 70, "height_mm": _HEIGHT_MM}, 310, 35),
)


@dataclass(frozen=True, slots=True)
class Arms:
    """Pushing arms.

    Attributes:
        name: in a row of a table.
        cell: the cell file.
        leader: the arm that pushes.
        sensors: all of them, the leader's first.
    """

    name: str
    cell: str
    leader: str
    sensors: tuple[str, ...]

    def around(self, pushed: Pushed, surface: str, height_mm: float) -> dict[str, Any]:
        """Return cell keys that place them around an object, at that height, 5 mm from touching it."""
        x_mm = -(pushed.reach_mm + _TIP_MM + _GAP_MM)
        changes: dict[str, Any] = {
            "scene.physics": "dynamic",
            "scene.table": {"friction": surface},
            f"arms.{self.leader}.start_pose_mm_deg": [x_mm, 0, height_mm, 180, 0, 0],
            "task.object_center_offset_mm": pushed.reach_mm + _TIP_MM,
        }
        if len(self.sensors) > 1:
            # The follower's base is a metre away and rotated by 180 degrees.
            changes["arms.follower.start_pose_mm_deg"] = [1000 + x_mm, 0, height_mm, 180, 0, 0]
        return changes

    def estimating(self, estimator: str) -> dict[str, Any]:
        """Return cell keys that give every sensor one of ``ESTIMATORS``."""
        section = ESTIMATORS[estimator]
        return {} if section is None else {f"sensors.{sensor}.estimator": dict(section) for sensor in self.sensors}


ONE_ARM = Arms("one arm", "single_push_sim.yaml", "arm", ("sensor",))
TWO_ARMS = Arms("two arms", "dual_push_sim.yaml", "leader", ("leader_sensor", "follower_sensor"))


def row_trials(row: str, cell: str, pushed: Pushed, changes: Mapping[str, Any], count: int) -> list[Trial]:
    """Return ``count`` trials of a row, each from another start near the origin, slightly shifted and rotated.

    Args:
        row: its name.
        cell: the cell file.
        pushed: the object.
        changes: keys of the cell, the same for all; they may change the object's as well.
        count: number of trials.
    """
    return [
        Trial(f"{_slug(row)}_{seed}", row, cell, {"scene.objects": {OBJECT: section}} | dict(changes) | {"seed": seed})
        for seed, section in _placed(pushed, count)
    ]


def _placed(pushed: Pushed, count: int) -> Iterator[tuple[int, dict[str, Any]]]:
    for seed in range(1, count + 1):
        rng = np.random.default_rng((20241, seed))
        y_mm, gamma_deg = rng.uniform(-_OFFSET_MM, _OFFSET_MM), rng.uniform(-_TURN_DEG, _TURN_DEG)
        pose_mm_deg = [0.0, round(float(y_mm), 3), 0.0, 0.0, 0.0, round(float(gamma_deg), 3)]
        yield seed, {"shape": dict(pushed.shape), "mass_g": pushed.mass_g, "pose_mm_deg": pose_mm_deg}


def _slug(row: str) -> str:
    words = row.translate({ord("+"): "more", ord("-"): "less", ord("/"): "by", ord("%"): "", ord(","): ""}).split()
    return "_".join(words)


def prism_experiment(name: str, summary: str, arms: Arms, paper: Mapping[str, str]) -> ExperimentSpec:
    """Return the experiment with the paper's four prisms over two surfaces, five trials each.

    Args:
        name: of the experiment.
        summary: one line.
        arms: pushing arms.
        paper: its figure, by prism.
    """

    def trials(scale: Scale) -> list[Trial]:
        """Return trials of every prism on every surface with both estimators."""
        return [
            trial
            for estimator in ESTIMATORS
            for surface in SURFACES
            for pushed in (PRISMS[:1] if scale.quick and estimator != "learned" else PRISMS)
            for trial in row_trials(
                f"{pushed.name}, {surface}, {estimator}",
                arms.cell,
                pushed,
                arms.around(pushed, surface, PUSH_HEIGHT_MM) | arms.estimating(estimator),
                scale.repetitions(5),
            )
        ]

    return ExperimentSpec(
        name=name,
        summary=summary,
        trials=trials,
        measure=push_measures,
        columns=COLUMNS,
        draw=_draw,
        paper={f"{p.name}, {surface}, {e}": paper[p.name] for p in PRISMS for surface in SURFACES for e in ESTIMATORS},
        notes=(ERROR_NOTE,),
    )


def _draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot the paper's figures 18 and 19, and every trial's error."""
    from touchcell.cell.experiments.pushing_plots import plot_errors, plot_pushes

    return [
        plot_pushes([each for each in finished if "learned_1" in each.trial.name], folder / "pushes.png"),
        plot_errors(finished, folder / "errors.png", aim_mm=2.0),
    ]


def push_measures(run: RunFolder) -> dict[str, float]:
    """Return the errors of object and contact normal at the end of the push, and the object's largest lean.

    The sensor is the one that pushes: with two arms the leader's. ``error_mm`` is the paper's: the distance from the
    target to the true line of the contact normal, in top view. A push that never arrived has none.
    """
    found = {"lean_max_deg": float(np.max(lean_deg(run)))}
    found["toppled"] = float(found["lean_max_deg"] > 45.0)
    errors = push_errors(run)
    arrived = any(event.data.get("event") == "finished" for event in run.recording.events)
    if arrived and "target_error_mm" in errors:
        found["error_mm"] = errors["target_error_mm"]
    return found | {name: value for name, value in errors.items() if name != "target_error_mm"}
