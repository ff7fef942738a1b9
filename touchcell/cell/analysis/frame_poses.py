"""Where the frames of a cell were during a run, from its recording."""

from __future__ import annotations

import numpy as np

from touchcell.cell.analysis.run_data import Run, Series, tip_points
from touchcell.cell.scene.description import SceneDescription
from touchcell.cell.scene.frames import WORLD, base_frame, object_frame, tcp_frame
from touchcell.geometry.types import Array


def frame_poses(run: Run, scene: SceneDescription, times_s: Array) -> dict[str, Array]:
    """Return the poses in the world of every frame that is known, (n, 4, 4) at ``times_s`` (n,), or (1, 4, 4) if still.

    Links are left out: a recording holds joints for viewers only.
    """
    poses: dict[str, Array] = {WORLD: np.eye(4)[None]}
    for frame in scene.frames:
        if frame.parent == WORLD:
            poses[frame.name] = frame.T_parent_frame[None]
    for role in run.roles("arms", "tcp"):
        series = run.series(f"/arms/{role}/tcp")
        if series is not None and base_frame(role) in poses:
            poses[tcp_frame(role)] = poses[base_frame(role)] @ _at(series, times_s)
    for topic, series in run.topics.items():
        if topic.startswith("/objects/"):
            poses[object_frame(topic.rpartition("/")[2])] = _at(series, times_s)
    for moved in scene.moving:
        poses[moved.name] = np.array([moved.pose(float(t_s) + 1e-9 * run.start_ns) for t_s in times_s])
    for frame in scene.frames:
        if frame.name not in poses and frame.parent in poses:
            poses[frame.name] = poses[frame.parent] @ frame.T_parent_frame
    return poses


def _at(series: Series, times_s: Array) -> Array:
    index = np.clip(np.searchsorted(series.t_s, times_s + 1e-6, side="right") - 1, 0, len(series.t_s) - 1)
    found: Array = tip_points(series)[index]
    return found
