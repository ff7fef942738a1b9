<<<<<<< HEAD
"""Limits that every cell needs: finite numbers, speed, depth, and the age of what was measured."""
=======
"""Interlocks that every cell needs: finite numbers, workspace, tilt, speed, depth, and age of the measurements."""
>>>>>>> main

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.planning_scene import PlanningScene, SpatialInterlockConfig
from touchcell.control.interlocks.settings import LEAVE, GradedSettings, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.timers import NO_MARKS, InterlockState, Judgement, TimedInterlock, TimerState
from touchcell.control.interlocks.violation import Severity, Violation
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


<<<<<<< HEAD
@dataclass(frozen=True, slots=True)
class TcpSpeed:
    """No tool centre point moves, or is told to move, faster than the limits; one that did is slow at 80 % of them."""
=======
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
>>>>>>> main

    name: str
    severity: Severity
    limit_m_s: float
    limit_rad_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The arm that exceeds a limit by the largest factor, measured or commanded."""
        marks: dict[str, TimerState] = {}
        worst: Violation | None = None
        worst_ratio = 0.0
        for role, arm in view.arms.items():
            share = LEAVE if role in past else 1.0
            twists = [("measured", arm.state.value.twist)]
            if arm.command is not None:
                twists.append(("commanded", arm.command.twist))
            for source, twist in twists:
                x, y, z, a, b, c = twist.tolist()
                for speed, full, unit in (
                    (math.sqrt(x * x + y * y + z * z), self.limit_m_s, "m/s"),
                    (math.sqrt(a * a + b * b + c * c), self.limit_rad_s, "rad/s"),
                ):
                    limit = share * full
                    if speed <= limit:
                        continue
                    marks[role] = TimerState(view.now_ns)
                    if speed / limit > worst_ratio:
                        worst_ratio = speed / limit
                        reason = f"{source} speed is {speed:.4g} {unit}, limit {limit:g} {unit}"
                        worst = Violation(
                            self.name, self.severity, role, reason, view.now_ns, value=speed, limit=limit, unit=unit
                        )
        return worst, marks or NO_MARKS


@dataclass(frozen=True, slots=True)
class Depth:
<<<<<<< HEAD
    """No sensor is pressed in deeper than the limit; one that was has to come out to 80 % of it."""
=======
    """Limit the indentation of every sensor."""
>>>>>>> main

    name: str
    severity: Severity
    limit_m: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The deepest of the sensors that are too deep."""
        marks: dict[str, TimerState] = {}
        deepest: Violation | None = None
        for role, sensor in view.sensors.items():
            depth_m = sensor.depth_m
            limit_m = LEAVE * self.limit_m if role in past else self.limit_m
            if depth_m is None or depth_m <= limit_m:
                continue
            marks[role] = TimerState(view.now_ns)
            if deepest is None or depth_m > (deepest.value or 0.0):
                reason = f"pressed in by {1e3 * depth_m:.2f} mm, limit {1e3 * limit_m:g} mm"
                deepest = Violation(
                    self.name,
                    self.severity,
                    role,
                    reason,
                    view.now_ns,
                    value=depth_m,
                    limit=limit_m,
                    unit="m",
                    frame_seq=sensor.seq,
                )
        return deepest, marks or NO_MARKS


@dataclass(frozen=True, slots=True)
class FrameAge:
<<<<<<< HEAD
    """Every sensor's newest frame is younger than the limit, none comes from the future, and none is missing."""
=======
    """Limit the age of every sensor's newest frame; a time stamp in the future is a violation too."""
>>>>>>> main

    name: str
    severity: Severity
    limit_s: float
    sensors: tuple[str, ...] = ()

    def check(self, view: CellView) -> Violation | None:
        """A sensor that is not in the view, or the one with the oldest frame."""
        for role in self.sensors:
            if role not in view.sensors:
                return _missing(self, "frame", role, view.now_ns)
        stamps = [(sensor.t_frame_ns, role, sensor.seq) for role, sensor in view.sensors.items()]
        return _check_ages(self, "newest frame", stamps, view.now_ns)


@dataclass(frozen=True, slots=True)
class ArmStateAge:
<<<<<<< HEAD
    """Every arm's newest state is younger than the limit, none comes from the future, and none is missing."""
=======
    """Limit the age of every arm's newest state; a time stamp in the future is a violation too."""
>>>>>>> main

    name: str
    severity: Severity
    limit_s: float
    arms: tuple[str, ...] = ()

    def check(self, view: CellView) -> Violation | None:
        """An arm that is not in the view, or the one with the oldest state."""
        for role in self.arms:
            if role not in view.arms:
                return _missing(self, "state", role, view.now_ns)
        stamps = [(arm.state.t_ns, role, None) for role, arm in view.arms.items()]
        return _check_ages(self, "newest state", stamps, view.now_ns)


def _missing(rule: FrameAge | ArmStateAge, what: str, role: str, now_ns: int) -> Violation:
    reason = f"there is no {what} of it in this cycle"
    return Violation(rule.name, rule.severity, role, reason, now_ns, limit=rule.limit_s, unit="s")


def _check_ages(
    rule: FrameAge | ArmStateAge, what: str, stamps: Sequence[tuple[int, str, int | None]], now_ns: int
) -> Violation | None:
<<<<<<< HEAD
    """The oldest of ``stamps`` (time, role and frame number) if it is too old, or one that lies in the future."""
    longest_ns = round(1e9 * rule.limit_s)
    wrong = [stamp for stamp in stamps if not 0 <= now_ns - stamp[0] <= longest_ns]
    if not wrong:
        return None
    t_ns, role, seq = min(wrong, key=lambda stamp: stamp[0])
    age_s = (now_ns - t_ns) * 1e-9
    reason = f"{what} is {1e3 * age_s:.1f} ms old, limit {1e3 * rule.limit_s:g} ms"
    return Violation(
        rule.name, rule.severity, role, reason, now_ns, value=age_s, limit=rule.limit_s, unit="s", frame_seq=seq
    )
=======
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
    """Cone for the z axis of a sensor, or of the tool of an arm without one; ``direction`` is along base axes."""

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
>>>>>>> main


class TcpSpeedConfig(InterlockSettings):
    """Largest speeds of any tool centre point."""

    kind: Literal["tcp_speed"]
    limit_m_s: PositiveFloat
    limit_rad_s: PositiveFloat

<<<<<<< HEAD
    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """The rule."""
=======
    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``TcpSpeed`` interlock."""
>>>>>>> main
        return TcpSpeed(name, self.level, self.limit_m_s, self.limit_rad_s)


class DepthConfig(GradedSettings):
    """Largest indentation of any sensor."""

    kind: Literal["depth"]
    limit_mm: PositiveFloat

<<<<<<< HEAD
    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """The rule."""
=======
    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``Depth`` interlock."""
>>>>>>> main
        return Depth(name, self.level, 1e-3 * self.limit_mm)


class FrameAgeConfig(InterlockSettings):
    """Largest age of a tactile frame."""

    kind: Literal["frame_age"]
    limit_ms: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
<<<<<<< HEAD
        """The rule."""
        return FrameAge(name, self.level, 1e-3 * self.limit_ms, tuple(sorted(T_tcp_sensor)))


class ArmStateAgeConfig(SpatialInterlockConfig):
    """Oldest arm state."""
=======
        """Return the ``FrameAge`` interlock."""
        return FrameAge(name, self.level, 1e-3 * self.limit_ms)


class ArmStateAgeConfig(InterlockSettings):
    """Largest age of an arm state."""
>>>>>>> main

    kind: Literal["arm_state_age"]
    limit_ms: PositiveFloat

<<<<<<< HEAD
    def build_in_scene(self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene) -> Interlock:
        """The rule."""
        return ArmStateAge(name, self.level, 1e-3 * self.limit_ms, tuple(sorted(planning_scene.T_world_base)))
=======
    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``ArmStateAge`` interlock."""
        return ArmStateAge(name, self.level, 1e-3 * self.limit_ms)
>>>>>>> main
