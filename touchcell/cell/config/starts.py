"""Where arms and sensors of a planned cell start, as far as its file says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan


def start_of_arm(plan: CellPlan, arm: str) -> Array | None:
    """Return the pose (4, 4) of an arm's tool in its base frame at the start, if the cell knows it."""
    pose = getattr(plan.arms[arm].config, "start_pose_mm_deg", None)
    return None if pose is None else pose_of(pose)


def start_of_sensor(plan: CellPlan) -> tuple[Array | None, Array]:
    """Return the start (4, 4) of the arm that carries the task's first sensor, and the sensor's mount (4, 4)."""
    if not plan.sensor_roles:
        return None, np.eye(4)
    sensor = plan.cell.sensors[plan.sensor_roles[min(plan.sensor_roles)]]
    start = None if sensor.mounted_on is None else start_of_arm(plan, sensor.mounted_on)
    return start, sensor.T_tcp_sensor


def pose_of(pose_mm_deg: Any) -> Array | None:
    """Return the pose (4, 4) of six numbers; None if they are none."""
    try:
        return se3.from_euler_mm_deg(pose_mm_deg)
    except GeometryError:
        return None
