"""A scene for a cell file that has none: something in front of each tip that its task can be done on.

Everything is derived from the file: the box and the cone that each tip is kept in, or a known surface, show where its
work is, and the task what has to be there. A tip starts 5 mm in front of what it will touch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from touchcell.cell.config.cell_plan import CellPlan, SensorSection
from touchcell.control.interlocks.boundary import TiltConfig, WorkspaceConfig
from touchcell.drivers.core.behaviour import ArmBehaviour
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_TIP_M: Final = 0.020
"""Radius of a simulated tip."""
_GAP_M: Final = 0.005
_PRISM_M: Final = (0.080, 0.080, 0.060)
_PRISM_G: Final = 479
_LONGEST_PUSH_M: Final = 0.120
_INSIDE_M: Final = 0.015
"""No start is nearer than this to the wall of its box."""
_DISC_M: Final = (0.050, 0.020)
"""Radius and height of a disc with an edge to follow."""
_FROM_THE_RIM_M: Final = 0.002
_TURNS: Final = 12


@dataclass(frozen=True, slots=True)
class Start:
    """Where an arm starts.

    Attributes:
        pose_mm_deg: of the tool in its base frame.
        q: (n,) rad its joints there; None for an arm whose chain is not known.
    """

    pose_mm_deg: tuple[float, float, float, float, float, float]
    q: Array | None


def start_of(plan: CellPlan, arm: str, given: Sequence[float] | None) -> Start:
    """Return where an arm starts: as given, or at the work that the file describes, or at its driver's home.

    Args:
        plan: the cell as its file describes it.
        arm: name of the arm.
        given: start pose of the tool in the base frame, [x y z] mm and [alpha beta gamma] deg.

    Raises:
        ConfigError: no joint angles reach any start pose.
    """
    device = plan.arms[arm]
    behaviour = None if device.spec.behaviour is None else device.spec.behaviour(device.config)
    chain = device.config.described_chain()
    home = np.deg2rad(behaviour.home_deg) if isinstance(behaviour, ArmBehaviour) else None
    wanted = [se3.from_euler_mm_deg(np.array(given))] if given is not None else list(_starts(plan, arm))
    if chain is None or home is None:
        if not wanted:
            raise ConfigError("is missing", key=f"arms.{arm}.start_pose_mm_deg", hint="add `start_pose_mm_deg:`")
        return Start(_six(wanted[0]), None)
    if not wanted:
        return Start(_six(chain.forward_and_jacobian(home)[0]), home)
    from touchcell.drivers.kinematics.inverse import joints_for_pose

    reached: list[tuple[float, Start]] = []
    missed = ""
    for T_base_tcp in wanted:
        try:
            q = joints_for_pose(chain, T_base_tcp, home)
        except ConfigError as error:
            missed = missed or error.reason
            continue
        reached.append((float(np.abs(q - home).max()), Start(_six(T_base_tcp), q)))
    if not reached:
        pose = [round(value, 1) for value in _six(wanted[0])]
        tool = "flange_to_tcp_mm_deg" if "flange_to_tcp_mm_deg" in type(device.config).model_fields else "tool"
        raise ConfigError(
            f"no joint angles reach the start pose {pose}: {missed}",
            file=str(plan.file),
            key=f"arms.{arm}.start_pose_mm_deg",
            value=pose,
            hint="correct it" if given is not None else f"set it, or correct the arm's workspace and {tool}",
        )
    return min(reached, key=lambda each: each[0])[1]


def default_scene(plan: CellPlan, starts: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Return a ``scene:`` section for a cell.

    Args:
        plan: the cell as its file describes it.
        starts: start pose of each arm's tool in its base frame, [x y z] mm and [alpha beta gamma] deg.
    """
    tips = {role: _tip(plan, role, starts) for role in plan.sensor_roles}
    if "target_mm" in type(plan.task_config).model_fields:
        return _table_with_prism(tips)
    if any(_section(plan, role).estimator.kind in _OF_EDGES for role in tips):
        return _discs(tips)
    surfaces = {}
    moves = plan.task.name == "object_tracking" or not plan.arms
    for role, T_world_s in tips.items():
        known = getattr(_section(plan, role).estimator, "surface_mm_deg", None)
        T_world_f = T_world_s @ _along(_GAP_M)
        if known is not None:
            T_world_f = _base(plan, role) @ se3.from_euler_mm_deg(known)
        plate: dict[str, Any] = {"kind": "plane", "pose_mm_deg": _rounded(_six(T_world_f @ _PLATE))}
        if moves:
            plate["motion"] = {
                "kind": "periodic",
                "amplitude_mm_deg": [8, 8, 4, 1, 1, 2],
                "period_s": 10,
                "ramp_s": 3,
            }
        surfaces[f"{role}_plate"] = plate
    return {"step_ms": 5, "surfaces": surfaces}


_OF_EDGES: Final = frozenset({"edge_network", "true_edge"})
"""Estimators of the edge under a tip."""


def _discs(tips: Mapping[str, Array]) -> dict[str, Any]:
    """Return a disc in front of each tip, which is over its face, a little inside the rim; x leads out over the rim."""
    radius_m, height_m = _DISC_M
    T_s_disc = np.diag([1.0, -1.0, -1.0, 1.0])
    T_s_disc[:3, 3] = [_FROM_THE_RIM_M - radius_m, 0.0, _TIP_M + _GAP_M + height_m]
    disc = {"kind": "cylinder", "radius_mm": 1e3 * radius_m, "height_mm": 1e3 * height_m}
    surfaces = {
        f"{role}_disc": {**disc, "pose_mm_deg": _rounded(_six(T_world_s @ T_s_disc))}
        for role, T_world_s in tips.items()
    }
    return {"step_ms": 5, "feels": "shape", "surfaces": surfaces}


_PLATE: Final = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, _TIP_M], [0, 0, 0, 1.0]])
"""T_f_plate (4, 4): the plate in the frame of a sensor that just touches it."""


def _table_with_prism(tips: Mapping[str, Array]) -> dict[str, Any]:
    """Return a prism on a table in front of the first tip, which pushes it; its middle 2 mm beside the line."""
    T_world_s = tips.get("leader_sensor", next(iter(tips.values())))
    ahead = T_world_s[:3, 2]
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    middle = T_world_s[:3, 3] + (_TIP_M + _GAP_M + _PRISM_M[0] / 2) * ahead
    middle[:2] += 0.002 * np.array([-np.sin(yaw), np.cos(yaw)])
    pose = [*(1e3 * middle[:2]), 0.0, 0.0, 0.0, np.degrees(yaw)]
    return {
        "physics": "quasi_static",
        "step_ms": 5,
        "table": {"friction": "mdf", "height_mm": round(float(1e3 * (middle[2] - _PRISM_M[2] / 2)), 4)},
        "tip": {"stiffness_n_mm": 0.6},
        "objects": {
            "prism": {
                "shape": {"kind": "box", "size_mm": [1e3 * size for size in _PRISM_M]},
                "mass_g": _PRISM_G,
                "pose_mm_deg": _rounded(pose),
            }
        },
    }


def _starts(plan: CellPlan, arm: str) -> Iterator[Array]:
    """Return T_base_tcp (4, 4) of every start that fits the file, turned about the sensor's axis."""
    role = next((role for role, name in plan.arm_roles.items() if name == arm), arm)
    sensor = next((each for each in plan.sensor_roles if _carrier(plan, each) == arm), None)
    T_tcp_s = np.eye(4) if sensor is None else _section(plan, sensor).T_tcp_sensor
    known = None if sensor is None else getattr(_section(plan, sensor).estimator, "surface_mm_deg", None)
    if known is not None:
        yield se3.from_euler_mm_deg(known) @ _along(-_GAP_M) @ se3.inverse(T_tcp_s)
        return
    box = next((each for each in _entries(plan, role, WorkspaceConfig)), None)
    if box is None:
        return
    cone = next((each for each in _entries(plan, role, TiltConfig)), None)
    ahead = np.array((0.0, 0.0, -1.0) if cone is None else cone.direction, dtype=np.float64)
    ahead /= np.linalg.norm(ahead)
    low, high = 1e-3 * np.array(box.min_mm), 1e-3 * np.array(box.max_mm)
    target_mm = getattr(plan.task_config, "target_mm", None)
    for turn in range(_TURNS):
        R = _facing(ahead) @ se3.from_euler_mm_deg([0, 0, 0, 0, 0, 360.0 * turn / _TURNS])[:3, :3]
        T_base_s = np.eye(4)
        T_base_s[:3, :3] = R
        if target_mm is None:
            T_base_s[:3, 3] = _before_a_surface(plan, R, low, high)
        else:
            T_base_s[:3, 3] = _before_a_prism(plan, arm, role, ahead, low, high)
        yield T_base_s @ se3.inverse(T_tcp_s)
        if target_mm is not None:
            # A pushing sensor has its x axis down.
            return


def _before_a_surface(plan: CellPlan, R: Array, low: Array, high: Array) -> Array:
    """Return where the tip starts: in the middle of its box, and half of the task's way back."""
    config = plan.task_config
    angle = np.radians(getattr(config, "direction_deg", 0.0))
    way_m = 1e-3 * float(getattr(config, "distance_mm", 0.0))
    back = 0.5 * way_m * (R @ np.array([np.cos(angle), np.sin(angle), 0.0]))
    start: Array = np.clip((low + high) / 2 - back - 2 * _GAP_M * R[:, 2], low + _INSIDE_M, high - _INSIDE_M)
    return start


def _before_a_prism(plan: CellPlan, arm: str, role: str, ahead: Array, low: Array, high: Array) -> Array:
    """Return where a tip starts: the leader behind the prism, as seen from the target, the follower before it."""
    leads = role != "follower"
    between_m = 2 * (_TIP_M + _GAP_M) + _PRISM_M[0]
    if leads:
        return _leader_start(plan, role, ahead, low, high)
    leader = plan.arm_roles["leader"]
    T_leader_tcp = next(iter(_starts(plan, leader)))
    sensor = next(each for each in plan.sensor_roles if _carrier(plan, each) == leader)
    T_leader_s = T_leader_tcp @ _section(plan, sensor).T_tcp_sensor
    T_world_s = plan.cell.arms[leader].T_world_base @ T_leader_s
    at = np.array([*(T_world_s[:3, 3] + between_m * T_world_s[:3, 2]), 1.0])
    start: Array = (se3.inverse(plan.cell.arms[arm].T_world_base) @ at)[:3]
    return start


def _leader_start(plan: CellPlan, role: str, ahead: Array, low: Array, high: Array) -> Array:
    """Return the point from which the prism, pushed straight ahead, comes to the target."""
    target = 1e-3 * np.array([*plan.task_config.model_dump()["target_mm"], 0.0])
    way_m = _LONGEST_PUSH_M + _TIP_M + _GAP_M + _PRISM_M[0] / 2
    middle = (low + high) / 2
    start = target - way_m * ahead
    start[2] = middle[2]
    inside: Array = np.clip(start, low + _INSIDE_M, high - _INSIDE_M)
    return inside


def _tip(plan: CellPlan, role: str, starts: Mapping[str, Sequence[float]]) -> Array:
    """Return T_world_s (4, 4) of a sensor at the start."""
    arm = _carrier(plan, role)
    T_base_tcp = np.eye(4) if arm is None else se3.from_euler_mm_deg(np.array(starts[arm]))
    return _base(plan, role) @ T_base_tcp @ _section(plan, role).T_tcp_sensor


def _base(plan: CellPlan, role: str) -> Array:
    """Return T_world_base (4, 4) of the arm that carries a sensor; the identity where none does."""
    arm = _carrier(plan, role)
    return np.eye(4) if arm is None else plan.cell.arms[arm].T_world_base


def _section(plan: CellPlan, role: str) -> SensorSection:
    return plan.cell.sensors[plan.sensor_roles[role]]


def _carrier(plan: CellPlan, role: str) -> str | None:
    return _section(plan, role).mounted_on


def _entries(plan: CellPlan, role: str, kind: type[Any]) -> Iterator[Any]:
    return (each for each in plan.cell.interlocks.values() if isinstance(each, kind) and each.arm == role)


def _facing(ahead: Array) -> Array:
    """Return a rotation (3, 3) whose z axis is ``ahead`` (3,): its x axis down if z is level."""
    x = np.array([1.0, 0.0, 0.0]) if abs(ahead[2]) > 0.7 else np.array([0.0, 0.0, -1.0])
    x = x - (x @ ahead) * ahead
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(ahead, x), ahead])


def _along(z_m: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z_m
    return T


def _six(T: Array) -> tuple[float, float, float, float, float, float]:
    x, y, z, a, b, c = (float(value) for value in se3.to_euler_mm_deg(T))
    return x, y, z, a, b, c


def _rounded(values: Sequence[float]) -> list[float]:
    return [round(float(value), 4) for value in values]
