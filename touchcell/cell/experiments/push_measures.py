"""Measures from the recording of a push."""

from __future__ import annotations

import math

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder, object_poses, scene_time
from touchcell.geometry.types import Array

OBJECT = "prism"


def target_mm(run: RunFolder) -> Array:
    """Return the target (2,), top view."""
    return np.array(run.plan.task_config.model_dump()["target_mm"], dtype=np.float64)


def pushed_until_s(run: RunFolder) -> float | None:
    """Return the scene time at which the task stopped pushing; None if it never pushed."""
    task = run.recording.series("/task")
    if task is None:
        return None
    running = np.flatnonzero([row.get("state") == "run" for row in task.rows])
    return float(scene_time(run, task)[running[-1]]) if len(running) else None


def off_normal_mm(T_world_f: Array, target_mm: Array) -> float:
    """Return the distance, in top view, of a target (2,) from the contact normal of a surface frame (4, 4)."""
    x, y = target_mm - 1e3 * T_world_f[:2, 3]
    along_x, along_y = T_world_f[:2, 2] / math.hypot(*T_world_f[:2, 2])
    return float(abs(along_x * y - along_y * x))


def lean_deg(run: RunFolder) -> Array:
    """Return the (n,) angle of the object's axis from the vertical over time."""
    upright = object_poses(run)[OBJECT].T_world[:, 2, 2]
    angle: Array = np.degrees(np.arccos(np.clip(upright, -1.0, 1.0)))
    return angle
