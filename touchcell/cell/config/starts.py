"""Where arms and sensors of a planned cell start, as far as its file says."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from touchcell.cell.config.rule_limits import is_kind
from touchcell.geometry import se3
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan
    from touchcell.drivers.core.scene import SceneSection


def start_of_arm(plan: CellPlan, arm: str) -> Array | None:
    """Return the pose (4, 4) of an arm's tool in its base frame at the start, if the cell knows it."""
    pose = given_start(plan, arm)
    return None if pose is None else pose_of(pose)


def given_start(plan: CellPlan, arm: str) -> Any:
    """Return an arm's start pose as the file or its driver gives it, [x y z] mm and [alpha beta gamma] deg, or None.

    A real arm starts where it is; its stand-in and its emulator start where its section of the file says.
    """
    pose = getattr(plan.arms[arm].config, "start_pose_mm_deg", None)
    if pose is None and plan.cell.world in ("sim", "emulated"):
        return plan.cell.arms[arm].start_pose_mm_deg
    return pose


def start_of_sensor(plan: CellPlan) -> tuple[Array | None, Array]:
    """Return the start (4, 4) of the arm that carries the task's first sensor, and the sensor's mount (4, 4)."""
    if not plan.sensor_roles:
        return None, np.eye(4)
    sensor = plan.cell.sensors[plan.sensor_roles[min(plan.sensor_roles)]]
    start = None if sensor.mounted_on is None else start_of_arm(plan, sensor.mounted_on)
    return start, sensor.T_tcp_sensor


def sensor_in_world(plan: CellPlan, sensor: str, T_base_tcp: Array | None = None) -> Array | None:
    """Return the pose (4, 4) of a sensor in the world, at the start or with the tool at a pose; None if unknown."""
    section = plan.cell.sensors[sensor]
    if section.mounted_on is None:
        return None
    T = start_of_arm(plan, section.mounted_on) if T_base_tcp is None else T_base_tcp
    base = pose_of(plan.cell.arms[section.mounted_on].base_pose_mm_deg)
    return None if T is None or base is None else base @ T @ section.T_tcp_sensor


def start_near(plan: CellPlan, scene: SceneSection, sensor: str) -> str:
    """Return, for people, a start of a sensor's arm from which it comes upon what it has to touch.

    Empty where the given start does, or none is known.
    """
    section = plan.cell.sensors[sensor]
    reach_mm = getattr(plan.task_config, "approach_distance_mm", None)
    arm, T_world_s = section.mounted_on, sensor_in_world(plan, sensor)
    if reach_mm is None or arm is None or T_world_s is None:
        return ""
    T_world_base = plan.cell.arms[arm].T_world_base

    def allowed(T: Array) -> bool:
        return _is_allowed(plan, sensor, se3.inverse(T_world_base) @ T)

    found = scene.start_near(T_world_s, 1e-3 * reach_mm, allowed, on_edge=plan.task.feature == "edge")
    if found is None:
        return ""
    T_base_tcp = se3.inverse(T_world_base) @ found @ se3.inverse(section.T_tcp_sensor)
    numbers = ", ".join(f"{value:g}" for value in np.round(se3.to_euler_mm_deg(T_base_tcp), 1) + 0.0)
    return f"arms.{arm}.start_pose_mm_deg: [{numbers}]"


def _is_allowed(plan: CellPlan, sensor: str, T_base_s: Array) -> bool:
    """Return whether the boxes and cones that guard a sensor let it start at a pose (4, 4)."""
    at_mm = 1e3 * T_base_s[:3, 3]
    rules: Iterable[Any] = plan.cell.interlocks.values()
    for rule in rules:
        if plan.sensor_roles.get(getattr(rule, "sensor", None) or "") != sensor:
            continue
        if is_kind(rule, "workspace") and not ((rule.min_mm <= at_mm) & (at_mm <= rule.max_mm)).all():
            return False
        if is_kind(rule, "tilt") and lean_rad(T_base_s[:3, 2], rule.direction) > math.radians(rule.limit_deg):
            return False
    return True


def lean_rad(axis: Array, direction: Sequence[float]) -> float:
    """Return the angle between a unit vector (3,) and the axis (3,) of a cone."""
    cone = np.array(direction) / np.linalg.norm(direction)
    return math.acos(min(max(float(axis @ cone), -1.0), 1.0))


def pose_of(pose_mm_deg: Any) -> Array | None:
    """Return the pose (4, 4) of six numbers; None if they are none."""
    try:
        return se3.from_euler_mm_deg(pose_mm_deg)
    except GeometryError:
        return None
