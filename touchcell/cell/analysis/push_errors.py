"""Where a pushed object ended: its own errors and the paper's, from a recording with ground truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from touchcell.cell.analysis.run_folder import (
    Poses,
    RunFolder,
    object_poses,
    scene_time,
    sensor_poses,
    true_contacts,
)
from touchcell.geometry import se3
from touchcell.geometry.types import Array


def push_errors(run: RunFolder) -> Mapping[str, float]:
    """Return the errors at the end of the push, in top view; empty for other tasks, and without ground truth.

    ``object_error_mm`` is the distance of the object's centre from the target, whether or not the push arrived.
    ``target_error_mm`` is the paper's: the distance from the target to the true line of the contact normal; only of a
    push that ended in contact. ``object_heading_error_deg`` is the true contact normal's error against
    ``goal_heading_deg``, where there is one.
    """
    settings, objects, end_s = run.plan.task_config.model_dump(), object_poses(run), pushed_until_s(run)
    if "target_mm" not in settings or not objects or end_s is None:
        return {}
    sensor, target = pushing_sensor(run), target_m(run)
    at = np.array([end_s])
    tip = sensor_poses(run, sensor).at(at)[0][:2, 3]
    centres = [poses.at(at)[0][:2, 3] for poses in objects.values()]
    centre = min(centres, key=lambda each: float(np.linalg.norm(each - tip)))
    found = {"object_error_mm": 1e3 * float(np.linalg.norm(target - centre))}
    T_world_f = surface_pose(run, sensor, end_s)
    if T_world_f is None:
        return found
    found["target_error_mm"] = off_normal_mm(T_world_f, 1e3 * target)
    goal_deg = settings.get("goal_heading_deg")
    if goal_deg is not None:
        normal = _T_world_base(run)[:2, :2].T @ T_world_f[:2, 2]
        found["object_heading_error_deg"] = math.remainder(
            math.degrees(math.atan2(normal[1], normal[0])) - goal_deg, 360.0
        )
    return found


def pushing_sensor(run: RunFolder) -> str:
    """Return the role of the sensor that pushes: with two arms the leader's."""
    roles = run.plan.sensor_roles
    return "leader_sensor" if "leader_sensor" in roles else next(iter(roles))


def target_m(run: RunFolder) -> Array:
    """Return the target (2,) in the world, top view."""
    x, y = run.plan.task_config.model_dump()["target_mm"]
    place: Array = (_T_world_base(run) @ np.array([1e-3 * x, 1e-3 * y, 0.0, 1.0]))[:2]
    return place


def pushed_until_s(run: RunFolder) -> float | None:
    """Return the scene time at which the task stopped pushing; None if it never pushed."""
    task = run.recording.series("/task")
    if task is None:
        return None
    running = np.flatnonzero([row.get("state") == "run" for row in task.rows])
    return float(scene_time(run, task)[running[-1]]) if len(running) else None


def surface_pose(run: RunFolder, sensor: str, t_s: float) -> Array | None:
    """Return ``T_world_f`` (4, 4) of the true contact at a scene time; None out of contact."""
    series, contacts = true_contacts(run, sensor)
    contact = Poses(scene_time(run, series), np.asarray(se3.from_euler_mm_deg(np.nan_to_num(contacts))))
    at = np.array([t_s])
    index = int(np.clip(np.searchsorted(contact.t_s, t_s + 1e-6, side="right") - 1, 0, len(contacts) - 1))
    if not np.isfinite(contacts[index]).all():
        return None
    T_world_s = sensor_poses(run, sensor).at(at)[0]
    return se3.compose(T_world_s, se3.inverse(contact.at(at)[0]))


def off_normal_mm(T_world_f: Array, target_mm: Array) -> float:
    """Return the distance, in top view, of a target (2,) from the contact normal of a surface frame (4, 4)."""
    x, y = target_mm - 1e3 * T_world_f[:2, 3]
    along_x, along_y = T_world_f[:2, 2] / math.hypot(*T_world_f[:2, 2])
    return float(abs(along_x * y - along_y * x))


def _T_world_base(run: RunFolder) -> Array:  # noqa: N802  the pose's own name
    plan = run.plan
    section = plan.cell.sensors[plan.sensor_roles[pushing_sensor(run)]]
    assert section.mounted_on is not None
    return plan.cell.arms[section.mounted_on].T_world_base
