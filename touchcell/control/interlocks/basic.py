"""Interlocks that every cell needs: finite numbers, workspace, tilt, speed, depth, and age of the measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import GradedSettings, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.errors import ConfigError
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Finite:
    """Require every number in the view and in the commands to be finite. Always on, and checked first."""

    name: str = "finite"
    severity: Severity = Severity.FAULT

    def check(self, view: CellView) -> Violation | None:
        for role, frame_seq, what, value in self._numbers(view):
            if not (math.isfinite(value) if isinstance(value, float) else all_finite(np.asarray(value))):
                reason = f"{what} is not finite"
                return Violation(self.name, self.severity, role, reason, view.now_ns, frame_seq=frame_seq)
        return None

    def _numbers(self, view: CellView) -> Iterator[tuple[str, int | None, str, Any]]:
        for role, arm in view.arms.items():
            if arm.command is not None:
                yield role, None, "commanded twist", arm.command.twist
                yield role, None, "commanded time-to-live", arm.command.ttl_s
            yield role, None, "measured pose", arm.state.value.T_base_tcp
            yield role, None, "measured twist", arm.state.value.twist
            if arm.joints is not None:
                yield role, None, "measured joint angles", arm.joints.value.q
        for role, sensor in view.sensors.items():
            for what, value in (
                ("depth", sensor.depth_m),
                ("depth deviation", sensor.sigma_depth_m),
                ("innovation", sensor.nis),
                ("shear", sensor.shear_m),
                ("torsion", sensor.torsion_rad),
                ("brightness", sensor.brightness),
                ("contact pose", sensor.T_s_f),
                ("share of markers", sensor.markers),
            ):
                if value is not None:
                    yield role, sensor.seq, what, value
        for role, device in view.devices.items():
            for name, number in ({} if device.reading is None else device.reading.value).items():
                yield role, None, name, float(number)
            for name, number in (device.setting or {}).items():
                yield role, None, f"set {name}", float(number)


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Keep a point of an arm's tool inside a box along the axes of the arm's base; motion back into it is allowed.

    Attributes:
        arm: role of the arm.
        T_tcp_point: pose (4, 4) of the guarded point in the tool frame: the sensor's, so that its length counts, or the
            identity.
        min_m: lower corner (3,).
        max_m: upper corner (3,).
    """

    name: str
    severity: Severity
    arm: str
    T_tcp_point: Array
    min_m: Array
    max_m: Array

    def check(self, view: CellView) -> Violation | None:
        arm = view.arms[self.arm]
        p = (arm.state.value.T_base_tcp @ self.T_tcp_point)[:3, 3]
        excess = np.maximum(self.min_m - p, p - self.max_m)
        axis = int(np.argmax(excess))
        if excess[axis] <= 0.0:
            return None
        v = arm.commanded_velocity(self.T_tcp_point)
        if v is not None and np.all(np.where(p > self.max_m, v < 0.0, np.where(p < self.min_m, v > 0.0, True))):
            return None
        limit = self.max_m[axis] if p[axis] > self.max_m[axis] else self.min_m[axis]
        reason = f"{'xyz'[axis]} = {1e3 * p[axis]:.1f} mm is outside the box, limit {1e3 * limit:g} mm"
        return Violation(
            self.name, self.severity, self.arm, reason, view.now_ns, value=float(p[axis]), limit=float(limit), unit="m"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Tilt:
    """Keep the z axis of an arm's tool, or of the sensor on it, in a cone; motion back into it is allowed.

    Attributes:
        arm: role of the arm.
        axis_tcp: (3,) unit vector of the guarded axis in the tool frame.
        direction: (3,) unit vector of the cone's axis along base axes.
        limit_rad: half of the cone's opening.
    """

    name: str
    severity: Severity
    arm: str
    axis_tcp: Array
    direction: Array
    limit_rad: float

    def check(self, view: CellView) -> Violation | None:
        arm = view.arms[self.arm]
        axis = arm.state.value.T_base_tcp[:3, :3] @ self.axis_tcp
        tilt_rad = math.acos(max(-1.0, min(1.0, float(axis @ self.direction))))
        if tilt_rad <= self.limit_rad:
            return None
        twist = arm.commanded_twist()
        if twist is not None and float(np.cross(twist[3:], axis) @ self.direction) > 0.0:
            return None
        reason = f"tilted by {math.degrees(tilt_rad):.1f} deg, limit {math.degrees(self.limit_rad):g} deg"
        return Violation(
            self.name, self.severity, self.arm, reason, view.now_ns, value=tilt_rad, limit=self.limit_rad, unit="rad"
        )


@dataclass(frozen=True, slots=True)
class TcpSpeed:
    """Limit the measured and the commanded speed of every tool centre point."""

    name: str
    severity: Severity
    limit_m_s: float
    limit_rad_s: float

    def check(self, view: CellView) -> Violation | None:
        worst: Violation | None = None
        worst_ratio = 1.0
        for role, arm in view.arms.items():
            twists = {"measured": arm.state.value.twist}
            if arm.command is not None:
                twists["commanded"] = arm.command.twist
            for source, twist in twists.items():
                for part, limit, unit in ((twist[:3], self.limit_m_s, "m/s"), (twist[3:], self.limit_rad_s, "rad/s")):
                    speed = math.sqrt(float(part @ part))
                    if speed > limit * worst_ratio:
                        worst_ratio = speed / limit
                        reason = f"{source} speed is {speed:.4g} {unit}, limit {limit:g} {unit}"
                        worst = Violation(
                            self.name, self.severity, role, reason, view.now_ns, value=speed, limit=limit, unit=unit
                        )
        return worst


@dataclass(frozen=True, slots=True)
class Depth:
    """Limit the indentation of every sensor."""

    name: str
    severity: Severity
    limit_m: float

    def check(self, view: CellView) -> Violation | None:
        depths = {role: s.depth_m for role, s in view.sensors.items() if s.depth_m is not None}
        role = max(depths, key=lambda r: depths[r], default=None)
        if role is None or depths[role] <= self.limit_m:
            return None
        return Violation(
            self.name,
            self.severity,
            role,
            f"pressed in by {1e3 * depths[role]:.2f} mm, limit {1e3 * self.limit_m:g} mm",
            view.now_ns,
            value=depths[role],
            limit=self.limit_m,
            unit="m",
            frame_seq=view.sensors[role].seq,
        )


@dataclass(frozen=True, slots=True)
class FrameAge:
    """Limit the age of every sensor's newest frame; a time stamp in the future is a violation too."""

    name: str
    severity: Severity
    limit_s: float

    def check(self, view: CellView) -> Violation | None:
        stamps = {role: (sensor.t_frame_ns, sensor.seq) for role, sensor in view.sensors.items()}
        return _check_ages(self, "newest frame", stamps, view.now_ns)


@dataclass(frozen=True, slots=True)
class ArmStateAge:
    """Limit the age of every arm's newest state; a time stamp in the future is a violation too."""

    name: str
    severity: Severity
    limit_s: float

    def check(self, view: CellView) -> Violation | None:
        stamps = {role: (arm.state.t_ns, None) for role, arm in view.arms.items()}
        return _check_ages(self, "newest state", stamps, view.now_ns)


def _check_ages(
    rule: FrameAge | ArmStateAge, what: str, stamps: Mapping[str, tuple[int, int | None]], now_ns: int
) -> Violation | None:
    """Return a violation for the oldest of ``stamps`` (time and frame number by role), or for one in the future."""
    for role, (t_ns, seq) in sorted(stamps.items(), key=lambda item: item[1][0]):
        age_s = (now_ns - t_ns) * 1e-9
        if not 0.0 <= age_s <= rule.limit_s:
            reason = f"{what} is {1e3 * age_s:.1f} ms old, limit {1e3 * rule.limit_s:g} ms"
            return Violation(
                rule.name,
                rule.severity,
                role,
                reason,
                now_ns,
                value=age_s,
                limit=rule.limit_s,
                unit="s",
                frame_seq=seq,
            )
    return None


class WorkspaceConfig(GradedSettings):
    """Box for a sensor, or for the tool centre point of an arm without one, along the axes of the arm's base.

    ``margin_mm`` is the free space around the box: a cell whose stopping distance may exceed it is refused.

    Attributes:
        arm: role of the arm.
        sensor: role of the sensor whose tip stays inside; none for the tool centre point.
        min_mm: lower corner of the box in the arm's base frame.
        max_mm: upper corner of the box.
        margin_mm: free space around the box: a cell whose stopping distance may exceed it is refused.
    """

    kind: Literal["workspace"]
    arm: str
    sensor: str | None = None
    min_mm: tuple[float, float, float]
    max_mm: tuple[float, float, float]
    margin_mm: PositiveFloat | None = None

    @model_validator(mode="after")
    def _corners_in_order(self) -> WorkspaceConfig:
        if not all(low < high for low, high in zip(self.min_mm, self.max_mm, strict=True)):
            raise ValueError(f"min_mm {list(self.min_mm)} is not below max_mm {list(self.max_mm)} in every axis")
        return self

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``Workspace`` interlock. Raises ConfigError for a sensor that the cell does not have."""
        T_tcp_point = _guarded(name, self.sensor, T_tcp_sensor)
        min_m, max_m = 1e-3 * np.array(self.min_mm), 1e-3 * np.array(self.max_mm)
        return Workspace(name, self.level, self.arm, T_tcp_point, min_m, max_m)


def _guarded(name: str, sensor: str | None, T_tcp_sensor: Mapping[str, Array]) -> Array:
    """Return the pose (4, 4) of the sensor in the tool frame, or the identity without one.

    Raises:
        ConfigError: the task has no such sensor.
    """
    if sensor is None:
        return np.eye(4)
    if sensor not in T_tcp_sensor:
        raise ConfigError(
            f"the task has no sensor {sensor!r}",
            key=f"interlocks.{name}.sensor",
            value=sensor,
            hint=f"sensors: {', '.join(sorted(T_tcp_sensor)) or 'none'}",
        )
    return T_tcp_sensor[sensor]


class TiltConfig(GradedSettings):
    """Cone for the z axis of a sensor, or of the tool of an arm without one; ``direction`` is along base axes.

    Attributes:
        arm: role of the arm.
        sensor: role of the sensor whose axis is meant; none for the tool's.
        direction: axis of the cone, along the axes of the arm's base.
        limit_deg: half of the cone's opening.
    """

    kind: Literal["tilt"]
    arm: str
    sensor: str | None = None
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    limit_deg: Annotated[float, Field(gt=0.0, le=180.0)]

    @model_validator(mode="after")
    def _has_direction(self) -> TiltConfig:
        if not any(self.direction):
            raise ValueError("direction is zero")
        return self

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``Tilt`` interlock. Raises ConfigError for a sensor that the cell does not have."""
        axis = _guarded(name, self.sensor, T_tcp_sensor)[:3, 2]
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        return Tilt(name, self.level, self.arm, axis, direction, math.radians(self.limit_deg))


class TcpSpeedConfig(InterlockSettings):
    """Largest speeds of any tool centre point.

    Attributes:
        limit_m_s: largest linear speed, commanded and measured.
        limit_rad_s: largest angular speed, likewise.
    """

    kind: Literal["tcp_speed"]
    limit_m_s: PositiveFloat
    limit_rad_s: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``TcpSpeed`` interlock."""
        return TcpSpeed(name, self.level, self.limit_m_s, self.limit_rad_s)


class DepthConfig(GradedSettings):
    """Largest indentation of any sensor.

    Attributes:
        limit_mm: largest indentation.
    """

    kind: Literal["depth"]
    limit_mm: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``Depth`` interlock."""
        return Depth(name, self.level, 1e-3 * self.limit_mm)


class FrameAgeConfig(InterlockSettings):
    """Largest age of a tactile frame.

    Attributes:
        limit_ms: oldest tactile frame that is accepted.
    """

    kind: Literal["frame_age"]
    limit_ms: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``FrameAge`` interlock."""
        return FrameAge(name, self.level, 1e-3 * self.limit_ms)


class ArmStateAgeConfig(InterlockSettings):
    """Largest age of an arm state.

    Attributes:
        limit_ms: oldest state of an arm that is accepted.
    """

    kind: Literal["arm_state_age"]
    limit_ms: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``ArmStateAge`` interlock."""
        return ArmStateAge(name, self.level, 1e-3 * self.limit_ms)


WORKSPACE = InterlockSpec("workspace", "sensor or tool stays inside a box in the arm's base frame", WorkspaceConfig)
TCP_SPEED = InterlockSpec("tcp_speed", "measured and commanded tool speed stay below limits", TcpSpeedConfig)
DEPTH = InterlockSpec("depth", "no sensor is pressed in too deep", DepthConfig)
FRAME_AGE = InterlockSpec("frame_age", "tactile frames are fresh", FrameAgeConfig)
ARM_STATE_AGE = InterlockSpec("arm_state_age", "arm states are fresh", ArmStateAgeConfig)
TILT = InterlockSpec("tilt", "sensor or tool points along a direction within a cone", TiltConfig)
