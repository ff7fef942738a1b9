"""What the pushing experiments share: the paper's objects, how a trial starts, and what is measured at its end.

The paper tells masses and not sizes, and that the sensor is 45 mm above the table. Sizes here follow from its masses at
one density: squares of 80 and 60 mm, a circle of 80 mm and a hexagon of 70 mm across flats, all 80 mm high.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.run_folder import Poses, RunFolder, object_poses, scene_time, sensor_poses, true_contacts
from cell.trial_table import Column
from geometry import se3
from geometry.types import Array

OBJECT = "prism"
SURFACES = ("mdf", "foam")
PUSH_HEIGHT_MM = 45.0
_HEIGHT_MM = 80.0
_GAP_MM = 5.0
_TIP_MM = 20.0
# How far an object stands from where it should: a person puts it there.
_OFFSET_MM, _TURN_DEG = 3.0, 2.0

ESTIMATORS: Mapping[str, Mapping[str, Any] | None] = {"learned": None, "true contact": {"kind": "true_contact"}}
"""Estimator sections by what rows call them; None for the cell file's own."""


COLUMNS = (
    Column("error_mm", "error mm", below=2.0),
    Column("error_mm", "worst", "worst"),
    Column("middle_mm", "middle to target mm"),
    Column("lean_max_deg", "lean deg", "worst"),
)
ERROR_NOTE = "error: from the target to the true contact normal when the push ends, from above"


@dataclass(frozen=True, slots=True)
class Pushed:
    """An object that is pushed.

    Attributes:
        name: as the paper calls it.
        shape: of the cell file's ``scene.objects``.
        mass_g: its mass.
        reach_mm: from its middle to where it is pushed.
    """

    name: str
    shape: Mapping[str, Any]
    mass_g: float
    reach_mm: float

    def taller(self, height_mm: float, mass_g: float) -> Pushed:
        """One of the same outline, that high."""
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


def starts(count: int) -> Iterator[tuple[int, list[float]]]:
    """(seed, pose_mm_deg) of an object in each of ``count`` trials: near the origin, a little aside and turned."""
    for seed in range(1, count + 1):
        rng = np.random.default_rng((20241, seed))
        y_mm, gamma_deg = rng.uniform(-_OFFSET_MM, _OFFSET_MM), rng.uniform(-_TURN_DEG, _TURN_DEG)
        yield seed, [0.0, round(float(y_mm), 3), 0.0, 0.0, 0.0, round(float(gamma_deg), 3)]


def leader_changes(pushed: Pushed, surface: str, arm: str, height_mm: float) -> dict[str, Any]:
    """Keys of a cell in which ``arm`` stands before an object, ``height_mm`` above the table, and looks along x."""
    x_mm = -(pushed.reach_mm + _TIP_MM + _GAP_MM)
    return {
        "scene.physics": "dynamic",
        "scene.table": {"friction": surface},
        f"arms.{arm}.start_pose_mm_deg": [x_mm, 0, height_mm, 180, 0, 0],
        "task.middle_mm": pushed.reach_mm + _TIP_MM,
    }


def follower_changes(pushed: Pushed, height_mm: float) -> dict[str, Any]:
    """Keys of a cell in which the follower stands on the other side, its base a metre away and turned round."""
    start = [1000 - (pushed.reach_mm + _TIP_MM + _GAP_MM), 0, height_mm, 180, 0, 0]
    return {"arms.follower.start_pose_mm_deg": start}


def estimator_changes(estimator: str, sensors: Iterable[str]) -> dict[str, Any]:
    """Keys that give every sensor the estimator."""
    section = ESTIMATORS[estimator]
    return {} if section is None else {f"sensors.{sensor}.estimator": dict(section) for sensor in sensors}


def object_changes(pushed: Pushed, pose_mm_deg: list[float]) -> dict[str, Any]:
    """Keys that put the object there."""
    section = {"shape": dict(pushed.shape), "mass_g": pushed.mass_g, "pose_mm_deg": pose_mm_deg}
    return {"scene.objects": {OBJECT: section}}


def push_measures(run: RunFolder, sensor: str) -> dict[str, float]:
    """Where the object and the contact normal were to the target when the push ended, and how far the object leant.

    ``error_mm`` is the paper's: the distance from the target to the true line of the contact normal, from above. A push
    that never arrived has none.
    """
    found = {"lean_max_deg": float(np.max(lean_deg(run)))}
    found["toppled"] = float(found["lean_max_deg"] > 45.0)
    end_s = pushed_until_s(run)
    if end_s is None or not any(event.data.get("event") == "finished" for event in run.recording.events):
        return found
    point, direction = contact_normal(run, sensor, end_s)
    target = target_mm(run)
    away = target - point
    middle = 1e3 * object_poses(run)[OBJECT].at(np.array([end_s]))[0, :2, 3]
    return found | {
        "error_mm": float(abs(direction[0] * away[1] - direction[1] * away[0])),
        "middle_mm": float(np.linalg.norm(target - middle)),
    }


def target_mm(run: RunFolder) -> Array:
    """(2,) the target, from above."""
    return np.array(run.plan.task_config.model_dump()["target_mm"], dtype=np.float64)


def pushed_until_s(run: RunFolder) -> float | None:
    """When the task stopped pushing, in time of the scene; None if it never pushed."""
    task = run.recording.series("/task")
    if task is None:
        return None
    running = np.flatnonzero([row.get("state") == "run" for row in task.rows])
    return float(scene_time(run, task)[running[-1]]) if len(running) else None


def contact_normal(run: RunFolder, sensor: str, t_s: float) -> tuple[Array, Array]:
    """A point (2,) mm on the line of the true contact normal, and its direction (2,), from above."""
    T_world_s = sensor_poses(run, sensor).at(np.array([t_s]))[0]
    series, contacts = true_contacts(run, sensor)
    felt = Poses(scene_time(run, series), np.asarray(se3.from_euler_mm_deg(np.nan_to_num(contacts))))
    T_world_f = se3.compose(T_world_s, se3.inverse(felt.at(np.array([t_s]))[0]))
    direction = T_world_f[:2, 2] / math.hypot(*T_world_f[:2, 2])
    return 1e3 * T_world_f[:2, 3], direction


def lean_deg(run: RunFolder) -> Array:
    """(n,) angle of the object's axis from upright over time."""
    upright = object_poses(run)[OBJECT].T_world[:, 2, 2]
    angle: Array = np.degrees(np.arccos(np.clip(upright, -1.0, 1.0)))
    return angle
