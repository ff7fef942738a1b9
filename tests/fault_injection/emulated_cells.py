"""Cell files for ``touchcell bench faults``: every task, built around the tool pose of an emulated arm.

Where a fault is injected into an arm, its sensor is simulated and touches a scene in front of its tool. Where it is
injected into a camera, the camera is mounted on a simulated arm, and the contact is computed from that arm's pose: the
emulated camera's images do not depend on the contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.testing.emulation.rig import DeviceFixture

FAULT_ROLES: Final = {
    "surface_following": ("arm",),
    "object_tracking": ("arm",),
    "single_arm_pushing": ("arm",),
    "dual_arm_pushing": ("leader", "follower"),
    "data_collection": ("arm",),
}
"""Roles of arms that may be the emulated one, by task. Each has a sensor, which may be the emulated one as well."""

DEVICE_ROLE: Final = "device"
"""Name of an emulated device that is neither arm nor camera."""

_GAP_M: Final = 0.004
_TIP_RADIUS_M: Final = 0.020
_PRISM_M: Final = (0.080, 0.080, 0.060)
_DOWN: Final = (180.0, 0.0, 0.0)
_GAP: Final = se3.from_euler_mm_deg([0.0, 0.0, 1e3 * _GAP_M, 0.0, 0.0, 0.0])

_SERVO: Final = {"approach_speed_mm_s": 8, "retract_mm": 8, "retract_speed_mm_s": 8, "stale_timeout_s": 2.0}
_TASKS: Final[Mapping[str, Mapping[str, Any]]] = {
    "surface_following": {**_SERVO, "distance_mm": 8, "speed_mm_s": 4},
    "object_tracking": {**_SERVO, "depth_mm": 3, "duration_s": 4},
    # What the sensors touch here is a plane, and has no edges to steer by.
    "single_arm_pushing": {**_SERVO, "steering": "bearing", "push_speed_mm_s": 3},
    "dual_arm_pushing": {
        **_SERVO,
        "steering": "bearing",
        "push_speed_mm_s": 3,
        "follower": {"reference_mm_deg": [0, 0, 2, 0, 0, 0]},
    },
    "data_collection": {
        "samples": 50,
        "depth_mm": [1.0, 2.5],
        "tilt_deg": 3,
        "shear_mm": 1,
        "torsion_deg": 1,
        "clearance_mm": 2,
        "speed_mm_s": 6,
        "press_speed_mm_s": 6,
        "turn_deg_s": 6,
        "settle_ms": 300,
        "max_frame_age_ms": 2000,
        "max_state_age_ms": 2000,
        "stale_timeout_s": 2.0,
    },
    "observe": {},
}


def sensor_of(role: str) -> str:
    """Return the role of the sensor that the arm in ``role`` carries."""
    return "sensor" if role == "arm" else f"{role}_sensor"


def arm_cell(
    task: str,
    role: str,
    rig: DeviceFixture,
    T_base_tcp: Array,
    collected: str,
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return a cell in which the emulated arm of ``rig`` has ``role`` in ``task``, its tool at ``T_base_tcp``.

    Args:
        task: of ``FAULT_ROLES``.
        role: of the arm with the fault; another one is simulated.
        rig: of the emulated arm.
        T_base_tcp: (4, 4) its tool in its base, which is the world frame.
        collected: folder for data collection.
        settings: keys of the task, of one that does not push.
    """
    assert rig.config is not None
    emulated = {"driver": rig.spec.name, "deactivate": "hold", **rig.config.model_dump(mode="json", exclude_unset=True)}
    arms: dict[str, Any] = {role: emulated}
    if not task.endswith("pushing"):
        scene: dict[str, Any] = {"surfaces": {"plate": _plate(T_base_tcp, moves=task == "object_tracking")}}
        estimator: dict[str, Any] = {"kind": "true_contact"}
        if task == "data_collection":
            estimator = _known_surface(T_base_tcp @ _GAP)
        sensors = {sensor_of(role): _simulated_sensor(role, np.eye(4), estimator)}
        extra = {"scene": scene, **_collect(task, collected)}
        return _cell(task, arms, sensors, {role: T_base_tcp[:3, 3]}, extra, settings)
    tip, ahead = T_base_tcp[:3, 3], _ahead(T_base_tcp)
    middle = tip + (_TIP_RADIUS_M + _GAP_M + _PRISM_M[0] / 2) * ahead
    sensors = {sensor_of(role): _simulated_sensor(role, _across(T_base_tcp, ahead), {"kind": "true_contact"})}
    tips = {role: tip}
    if task == "dual_arm_pushing":
        other = next(name for name in FAULT_ROLES[task] if name != role)
        T_other = se3.from_euler_mm_deg(np.array([*(1e3 * (2.0 * middle - tip)), *_DOWN]))
        arms[other] = _simulated_arm(T_other)
        sensors[sensor_of(other)] = _simulated_sensor(other, _across(T_other, -ahead), {"kind": "true_contact"})
        tips[other] = T_other[:3, 3]
    pushes = -ahead if role == "follower" else ahead
    yaw_deg = np.degrees(np.arctan2(ahead[1], ahead[0]))
    scene = {
        "physics": "quasi_static",
        "step_ms": 10,
        "table": {"friction": "mdf", "height_mm": float(1e3 * (middle[2] - _PRISM_M[2] / 2))},
        "tip": {"stiffness_n_mm": 0.6},
        "objects": {
            "prism": {
                "shape": {"kind": "box", "size_mm": [1e3 * size for size in _PRISM_M]},
                "mass_g": 479,
                "pose_mm_deg": [float(1e3 * middle[0]), float(1e3 * middle[1]), 0.0, 0.0, 0.0, float(yaw_deg)],
            }
        },
    }
    target = {"target_mm": (1e3 * (middle + 0.05 * pushes)[:2]).tolist()}
    return _cell(task, arms, sensors, tips, {"scene": scene}, target)


def camera_cell(
    task: str, cameras: Mapping[str, DeviceFixture], collected: str, of_state: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a cell in which the emulated cameras, by role of their sensor, are mounted on simulated arms.

    ``of_state`` are keys of the task.
    """
    roles = FAULT_ROLES.get(task, ())
    arms, sensors, tips = {}, {}, {}
    settings: dict[str, Any] = dict(of_state)
    for number, role in enumerate(roles):
        # Far enough apart that they do not meet.
        T_base_tcp = se3.from_euler_mm_deg([400.0, 400.0 * number, 300.0, *_DOWN])
        T_tcp_s = np.eye(4)
        if task.endswith("pushing"):
            T_tcp_s = _across(T_base_tcp, np.array([1.0, 0.0, 0.0]))
            settings.setdefault("target_mm", (1e3 * T_base_tcp[:2, 3] + [100.0, 0.0]).tolist())
        arms[role], tips[role] = _simulated_arm(T_base_tcp), T_base_tcp[:3, 3]
        surface = _known_surface(T_base_tcp @ T_tcp_s @ _GAP)
        sensors[sensor_of(role)] = _emulated_sensor(cameras[sensor_of(role)], surface, role, T_tcp_s)
    if not roles:
        # Without an arm only the image shows a contact.
        sensors["sensor"] = _emulated_sensor(cameras["sensor"], {"kind": "network", "model": "builtin:sim_gdn"})
    # Where the network reads frames, it does so in a thread: in the loop's own it is tried with simulated faults.
    extra = {**_collect(task, collected), "perceive_in": "threads"}
    data = _cell(task, arms, sensors, tips, extra, settings)
    data["interlocks"] |= {
        "stale_frame": {"kind": "frame_age", "limit_ms": 200},
        "frozen_frame": {"kind": "frame_frozen", "limit_ms": 300},
        "exposure": {"kind": "exposure", "limit_percent": 15},
    }
    return data


def device_cell(rig: DeviceFixture) -> dict[str, Any]:
    """Return a cell that follows a surface with simulated devices, and reads the emulated device of ``rig`` besides."""
    assert rig.config is not None
    T_base_tcp = se3.from_euler_mm_deg([400.0, 0.0, 300.0, *_DOWN])
    scene = {"surfaces": {"plate": _plate(T_base_tcp, moves=False)}}
    sensors = {"sensor": _simulated_sensor("arm", np.eye(4), {"kind": "true_contact"})}
    arms = {"arm": _simulated_arm(T_base_tcp)}
    data = _cell("surface_following", arms, sensors, {"arm": T_base_tcp[:3, 3]}, {"scene": scene})
    data["devices"] = {DEVICE_ROLE: {"driver": rig.spec.name, **rig.config.model_dump(mode="json", exclude_unset=True)}}
    data["interlocks"]["stale_device"] = {"kind": "reading_age", "limit_ms": 500}
    return data


def _cell(
    task: str,
    arms: Mapping[str, Any],
    sensors: Mapping[str, Any],
    tips: Mapping[str, Array],
    extra: Mapping[str, Any],
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    boxes = {
        f"{role}_box": {
            "kind": "workspace",
            "arm": role,
            "sensor": sensor_of(role),
            "min_mm": (1e3 * tip - 120.0).tolist(),
            "max_mm": (1e3 * tip + 120.0).tolist(),
            "margin_mm": 60,
        }
        for role, tip in tips.items()
    }
    moving = {
        **boxes,
        "tcp_speed": {"kind": "tcp_speed", "limit_m_s": 0.25, "limit_rad_s": 1.4},
        "indentation": {"kind": "depth", "limit_mm": 9},
        "stale_frame": {"kind": "frame_age", "limit_ms": 500},
        "stale_arm": {"kind": "arm_state_age", "limit_ms": 300},
    }
    return {
        "schema": 1,
        "name": f"matrix_{task}",
        "time": "real",
        # Pushed objects are simulated in parallel to a driver and its watchdog.
        "rate_hz": 25 if task.endswith("pushing") else 50,
        "arms": dict(arms),
        "sensors": dict(sensors),
        "interlocks": moving if arms else {},
        "task": {"name": task, **_TASKS[task], **(settings or {})},
        **extra,
    }


def _plate(T_base_tcp: Array, *, moves: bool) -> dict[str, Any]:
    T_tcp_plate = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tcp_plate[2, 3] = _TIP_RADIUS_M + _GAP_M
    plate: dict[str, Any] = {"kind": "plane", "pose_mm_deg": se3.to_euler_mm_deg(T_base_tcp @ T_tcp_plate).tolist()}
    if moves:
        plate["motion"] = {"kind": "periodic", "amplitude_mm_deg": [2, 2, 1, 0, 0, 0], "period_s": 4, "ramp_s": 2}
    return plate


def _ahead(T_base_tcp: Array) -> Array:
    """Return the (3,) horizontal direction from the base to the tool."""
    out = T_base_tcp[:2, 3]
    return np.array([*(out / np.linalg.norm(out)), 0.0])


def _across(T_base_tcp: Array, ahead: Array) -> Array:
    """Return the (4, 4) sensor in the tool that faces along ``ahead`` (3,) in the base, its own x axis down."""
    down = np.array([0.0, 0.0, -1.0])
    T_tcp_s = np.eye(4)
    T_tcp_s[:3, :3] = T_base_tcp[:3, :3].T @ np.column_stack([down, np.cross(ahead, down), ahead])
    return T_tcp_s


def _simulated_arm(T_base_tcp: Array) -> dict[str, Any]:
    return {
        "driver": "sim_arm",
        "deactivate": "hold",
        "start_pose_mm_deg": se3.to_euler_mm_deg(T_base_tcp).tolist(),
        "limits": {"tcp_speed_m_s": 0.1, "tcp_accel_m_s2": 0.5},
    }


def _simulated_sensor(arm: str, T_tcp_s: Array, estimator: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "driver": "sim_tactip",
        "mounted_on": arm,
        "tcp_to_sensor_mm_deg": se3.to_euler_mm_deg(T_tcp_s).tolist(),
        "rate_hz": 30,
        "latency_ms": 0,
        "estimator": dict(estimator),
    }


def _emulated_sensor(
    rig: DeviceFixture, estimator: Mapping[str, Any], arm: str | None = None, T_tcp_s: Array | None = None
) -> dict[str, Any]:
    assert rig.config is not None
    place = (
        {}
        if arm is None or T_tcp_s is None
        else {
            "mounted_on": arm,
            "tcp_to_sensor_mm_deg": se3.to_euler_mm_deg(T_tcp_s).tolist(),
        }
    )
    config = rig.config.model_dump(mode="json", exclude_unset=True)
    return {"driver": rig.spec.name, **config, **place, "estimator": dict(estimator)}


def _known_surface(T_base_f: Array) -> dict[str, Any]:
    return {"kind": "known_surface", "surface_mm_deg": se3.to_euler_mm_deg(T_base_f).tolist()}


def _collect(task: str, folder: str) -> dict[str, Any]:
    return {"collect": {"data": folder, "shares": {"train": 1}}} if task == "data_collection" else {}


def sensors_of(task: str) -> Sequence[str]:
    """Return the roles of the sensors of a task."""
    return [sensor_of(role) for role in FAULT_ROLES[task]] if task in FAULT_ROLES else ["sensor"]
