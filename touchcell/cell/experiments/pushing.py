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
from touchcell.cell.analysis.run_folder import RunFolder, during
from touchcell.cell.experiments.push_measures import AIM_MM, OBJECT, lean_deg
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished, Trial
from touchcell.simulation.objects import TABLES

SURFACES = ("mdf", "foam")
PUSH_HEIGHT_MM = 45.0
_HEIGHT_MM = 80.0
_GAP_MM = 5.0
_ROOM_MM = 15.0
_TIP_MM = 20.0
# Placement of an object: by hand where truth and belief match, and anywhere in front of the arm where truth is sampled.
_OFFSET_MM, _TURN_DEG = 3.0, 2.0
_SAMPLED_OFFSET_MM, _SAMPLED_TURN_DEG = 20.0, 20.0

ESTIMATORS: Mapping[str, Mapping[str, Any] | None] = {"learned": None, "true contact": {"kind": "true_contact"}}
"""Estimator sections by their name in rows; None for the cell file's own."""


COLUMNS = (
    Column("object_error_mm", "object mm", below=AIM_MM),
    Column("object_error_mm", "worst", "worst"),
    Column("object_heading_error_deg", "heading deg"),
    Column("push_s", "push s", digits=1),
    Column("error_mm", "normal mm"),
    Column("lean_max_deg", "lean deg", "worst"),
)
ERROR_NOTE = (
    "object: distance of its centre from the target; normal: of the target from the true contact normal, the paper's "
    "measure; both at the end of the push, in top view, of all pushes. "
    "push: duration, steps aside and second touches included"
)
MATCHED = "matched"
"""Rows in which the world is what the controllers are told."""


def sampled_truth(mass_g: float, friction: float, sensors: Sequence[str], arms: Sequence[str]) -> dict[str, Any]:
    """Return a ``truth:`` section in which nothing is quite what the controllers assume.

    The tip is the one fitted to the images of a real sensor, with another camera than the network was trained on.

    Args:
        mass_g: of the object, as it is told.
        friction: of the table, as it is told.
        sensors, arms: names of all of them.
    """
    sensor = {
        "tip": "franka_tactip_1",
        "mount_offset_mm_deg": [{"normal": [0, 0.2]}] * 3 + [{"normal": [0, 0.3]}] * 3,
        "latency_ms": {"uniform": [5, 25]},
        "noise": {"uniform": [1, 4]},
        "exposure": {"uniform": [0.9, 1.1]},
    }
    offset_mm, turn_deg = _SAMPLED_OFFSET_MM, _SAMPLED_TURN_DEG
    arm = {"latency_ms": {"uniform": [0, 15]}, "lag_ms": {"uniform": [2, 15]}, "velocity_step_mm_s": 0.1}
    return {
        "arms": dict.fromkeys(arms, arm),
        "sensors": dict.fromkeys(sensors, sensor),
        "tip": {
            "stiffness_n_mm": {"uniform": [0.55, 0.65]},
            "friction": {"uniform": [0.75, 1.0]},
            "slip_at_1mm_mm": {"uniform": [0.28, 0.4]},
        },
        "objects": {
            OBJECT: {
                "mass_g": {"uniform": [0.9 * mass_g, 1.1 * mass_g]},
                "friction": {"uniform": [0.9 * friction, 1.1 * friction]},
                "center_of_mass_mm": [{"normal": [0, 0.5]}, {"normal": [0, 0.5]}],
                "pose_offset_mm_deg": [
                    {"uniform": [0, 10]},
                    {"uniform": [-offset_mm, offset_mm]},
                    0,
                    0,
                    0,
                    {"uniform": [-turn_deg, turn_deg]},
                ],
            }
        },
        "table": {"tilt_deg": [{"normal": [0, 0.3]}, {"normal": [0, 0.3]}]},
    }


@dataclass(frozen=True, slots=True)
class Pushed:
    """An object that is pushed.

    Attributes:
        name: name in the paper.
        shape: of the cell file's ``scene.objects``.
        mass_g: its mass.
        reach_mm: distance from its centre to the contact.
        sides: as in the task: ``flat`` or ``round``.
        side_mm: width of the pushed side, where it is flat.
    """

    name: str
    shape: Mapping[str, Any]
    mass_g: float
    reach_mm: float
    sides: str = "flat"
    side_mm: float | None = None

    def taller(self, height_mm: float, mass_g: float) -> Pushed:
        """Return an object of the same outline with that height."""
        tall = dict(self.shape)
        if "size_mm" in tall:
            tall["size_mm"] = [*tall["size_mm"][:2], height_mm]
        else:
            tall["height_mm"] = height_mm
        return Pushed(f"tall {self.name}", tall, mass_g, self.reach_mm, self.sides, self.side_mm)


PRISMS = (
    Pushed("large square", {"kind": "box", "size_mm": [80, 80, _HEIGHT_MM]}, 479, 40, side_mm=80),
    Pushed("circular", {"kind": "cylinder", "diameter_mm": 80, "height_mm": _HEIGHT_MM}, 363, 40, "round"),
    Pushed("small square", {"kind": "box", "size_mm": [60, 60, _HEIGHT_MM]}, 264, 30, side_mm=60),
    Pushed("hexagonal", {"kind": "hexagon", "width_mm": 70, "height_mm": _HEIGHT_MM}, 310, 35, side_mm=40.4),
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
            "task.sides": pushed.sides,
            "task.side_width_mm": pushed.side_mm,
        }
        if len(self.sensors) > 1:
            # The follower's base is a metre away and rotated by 180 degrees.
            changes["arms.follower.start_pose_mm_deg"] = [1000 + x_mm, 0, height_mm, 180, 0, 0]
        return changes

    def sampling(self, pushed: Pushed, surface: str) -> dict[str, Any]:
        """Return cell keys under which truth is sampled apart from what the controllers assume."""
        arms = (self.leader, "follower")[: len(self.sensors)]
        start_mm = self.around(pushed, surface, PUSH_HEIGHT_MM)[f"arms.{self.leader}.start_pose_mm_deg"]
        changes: dict[str, Any] = {"truth": sampled_truth(pushed.mass_g, TABLES[surface], self.sensors, arms)}
        # A turned object reaches farther towards the arms.
        changes[f"arms.{self.leader}.start_pose_mm_deg"] = [start_mm[0] - _ROOM_MM, *start_mm[1:]]
        if len(self.sensors) > 1:
            changes["arms.follower.start_pose_mm_deg"] = [1000 + start_mm[0] - _ROOM_MM - 10, *start_mm[1:]]
        return changes

    def estimating(self, estimator: str) -> dict[str, Any]:
        """Return cell keys that give every sensor one of ``ESTIMATORS``."""
        section = ESTIMATORS[estimator]
        return {} if section is None else {f"sensors.{sensor}.estimator": dict(section) for sensor in self.sensors}


ONE_ARM = Arms("one arm", "single_push_sim.yaml", "arm", ("sensor",))
TWO_ARMS = Arms("two arms", "dual_push_sim.yaml", "leader", ("leader_sensor", "follower_sensor"))


def row_trials(
    row: str, cell: str, pushed: Pushed, changes: Mapping[str, Any], count: int, *, placed: bool = True
) -> list[Trial]:
    """Return ``count`` trials of a row, each from another start near the origin, slightly shifted and rotated.

    Args:
        row: its name.
        cell: the cell file.
        pushed: the object.
        changes: keys of the cell, the same for all; they may change the object's as well.
        count: number of trials.
        placed: False where the truth says where the object stands.
    """
    return [
        Trial(f"{_slug(row)}_{seed}", row, cell, {"scene.objects": {OBJECT: section}} | dict(changes) | {"seed": seed})
        for seed, section in _placed(pushed, count, 1.0 if placed else 0.0)
    ]


def _placed(pushed: Pushed, count: int, scale: float) -> Iterator[tuple[int, dict[str, Any]]]:
    for seed in range(1, count + 1):
        rng = np.random.default_rng((20241, seed))
        y_mm, gamma_deg = rng.uniform(-_OFFSET_MM, _OFFSET_MM), rng.uniform(-_TURN_DEG, _TURN_DEG)
        pose_mm_deg = [0.0, round(scale * float(y_mm), 3), 0.0, 0.0, 0.0, round(scale * float(gamma_deg), 3)]
        yield seed, {"shape": dict(pushed.shape), "mass_g": pushed.mass_g, "pose_mm_deg": pose_mm_deg}


def _slug(row: str) -> str:
    words = row.translate({ord("+"): "more", ord("-"): "less", ord("/"): "by", ord("%"): "", ord(","): ""}).split()
    return "_".join(words)


CONDITIONS: Mapping[str, tuple[str, int]] = {
    "": ("learned", 10),
    MATCHED: ("learned", 5),
    f"{MATCHED}, true contact": ("true contact", 2),
}
"""Estimator and number of trials by what stands in a row's name; nothing where truth is sampled."""


def prism_experiment(name: str, summary: str, arms: Arms, paper: Mapping[str, str]) -> ExperimentSpec:
    """Return the experiment with the paper's four prisms over two surfaces, ten trials each, and five matched ones.

    Args:
        name: of the experiment.
        summary: one line.
        arms: pushing arms.
        paper: its figure, by prism.
    """

    def trials(scale: Scale) -> list[Trial]:
        """Return trials of every prism on every surface, with truth sampled and matched, with both estimators."""
        return [
            trial
            for condition, (estimator, count) in CONDITIONS.items()
            for surface in SURFACES
            for pushed in (PRISMS[:1] if scale.quick and condition else PRISMS)
            for trial in row_trials(
                ", ".join(filter(None, (pushed.name, surface, condition))),
                arms.cell,
                pushed,
                arms.around(pushed, surface, PUSH_HEIGHT_MM)
                | ({} if condition else arms.sampling(pushed, surface))
                | arms.estimating(estimator),
                scale.repetitions(count),
                placed=bool(condition),
            )
        ]

    return ExperimentSpec(
        name=name,
        summary=summary,
        trials=trials,
        measure=push_measures,
        columns=COLUMNS,
        draw=_draw,
        paper={f"{p.name}, {surface}": paper[p.name] for p in PRISMS for surface in SURFACES},
        notes=(ERROR_NOTE,),
    )


def _draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot the paper's figures 18 and 19, and every trial's error."""
    from touchcell.cell.experiments.pushing_plots import plot_errors, plot_pushes

    first = [each for each in finished if each.trial.name.endswith(("mdf_1", "foam_1"))]
    return [
        plot_pushes(first, folder / "pushes.png"),
        plot_errors(finished, folder / "errors.png"),
    ]


def push_measures(run: RunFolder) -> dict[str, float]:
    """Return the errors of object and contact normal at the end of the push, and the object's largest lean.

    The sensor is the one that pushes: with two arms the leader's. ``error_mm`` is the paper's: the distance from the
    target to the true line of the contact normal, in top view. A push that never arrived has none.
    """
    found = {"lean_max_deg": float(np.max(lean_deg(run)))}
    found["toppled"] = float(found["lean_max_deg"] > 45.0)
    errors = push_errors(run)
    task = run.recording.series("/task")
    if task is not None and len(times := task.t_s[during(run, task)]):
        found["push_s"] = float(times[-1] - times[0])
    arrived = any(event.data.get("event") == "finished" for event in run.recording.events)
    if arrived and "target_error_mm" in errors:
        found["error_mm"] = errors["target_error_mm"]
    return found | {name: value for name, value in errors.items() if name != "target_error_mm"}
