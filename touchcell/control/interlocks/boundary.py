"""Where an arm may be: a box for a point of it, a cone for an axis of it. Motion back is allowed, if it really is.

Once outside, a point or an axis counts as outside until it is back by a fifth: of the margin of a box, of the opening
of a cone. Meanwhile a command passes that leads back: mostly inwards, faster than standing still, while the arm is not
measured to move outwards, and after a moment is measured to move inwards too. A command of -1 nm/s is no way back, nor
is one that an arm does not follow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from touchcell.control.interlocks.coverage import (
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    just_beyond,
    mount_problem,
    role_problem,
    with_motion,
)
from touchcell.control.interlocks.settings import LEAVE, GradedSettings
from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import NO_MARKS, InterlockState, Judgement, TimedInterlock, TimerState
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

REST_M_S: Final = 1e-3
"""A point that moves no faster stands still."""
REST_RAD_S: Final = 1e-2
"""The same for an axis."""
PROGRESS_NS: Final = 300_000_000
"""Within this time an arm that is commanded back has to be measured on its way back."""
_INWARD_SHARE = 1.0 / 3.0
"""Least share of a motion's speed that leads back: within 70 deg of straight back."""

_OUT, _BACK = "outside", "coming back"


@dataclass(frozen=True, slots=True)
class WayBack:
    """Commanded and measured motion back inside, in m/s or rad/s.

    Attributes:
        inward: how fast the command leads back.
        speed: how fast it leads anywhere.
        measured_inward: how fast the arm is measured to move back; negative outwards.
        rest: speeds up to this are none.
    """

    inward: float
    speed: float
    measured_inward: float
    rest: float

    @property
    def is_asked(self) -> bool:
        """True if the command really leads back."""
        return self.inward >= self.rest and self.inward >= _INWARD_SHARE * self.speed

    def is_followed(self, lasted_ns: int) -> bool:
        """Return True if the arm does not move outwards, and inwards once it has been commanded back for a while."""
        least = 0.5 * self.rest if lasted_ns >= PROGRESS_NS else -2.0 * self.rest
        return self.measured_inward >= least


_NO_WAY = WayBack(0.0, 0.0, 0.0, REST_M_S)


def _judge(violation: Violation, way: WayBack, past: InterlockState) -> Judgement:
    """Return ``violation`` unless the way back is taken; the state lasts until the caller finds it well inside."""
    marks = {_OUT: past[_OUT]} if _OUT in past else {}
    if way.is_asked:
        since = marks[_BACK] = past.get(_BACK, TimerState(violation.t_ns))
        if way.is_followed(violation.t_ns - since.since_ns):
            return None, marks
    marks[_OUT] = TimerState(violation.t_ns)
    return violation, marks


def point_velocity(twist: Array, R_base_tcp: Array, lever_m: Array) -> tuple[float, float, float]:
    """Return the velocity along base axes of a point ``lever_m`` (3,) from the tool centre point, along tool axes."""
    vx, vy, vz, wx, wy, wz = twist.tolist()
    x, y, z = (R_base_tcp @ lever_m).tolist()
    return vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Keep a point of an arm's tool inside a box along the axes of the arm's base; motion back into it is allowed.

    Attributes:
        arm: role of the arm.
        T_tcp_point: pose (4, 4) of the guarded point in the tool frame: the sensor's, so that its length counts, or the
            identity.
        min_m: lower corner (3,).
        max_m: upper corner (3,).
        leave_m: how far inside a point that was outside has to be to count as inside.
    """

    name: str
    severity: Severity
    arm: str
    T_tcp_point: Array
    min_m: Array
    max_m: Array
    leave_m: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the axis along which the point is furthest outside, unless it comes back."""
        arm = view.arms[self.arm]
        T = arm.state.value.T_base_tcp
        p = (T[:3, :3] @ self.T_tcp_point[:3, 3] + T[:3, 3]).tolist()
        inset_m = self.leave_m if _OUT in past else 0.0
        low, high = self.min_m.tolist(), self.max_m.tolist()
        out = [max(a + inset_m - x, x - b + inset_m) for x, a, b in zip(p, low, high, strict=True)]
        if max(out) <= 0.0:
            return None, NO_MARKS
        axis = out.index(max(out))
        above = p[axis] - high[axis] > low[axis] - p[axis]
        limit = high[axis] if above else low[axis]
        reason = f"{'xyz'[axis]} = {1e3 * p[axis]:.1f} mm is outside the box, limit {1e3 * limit:g} mm"
        if out[axis] <= inset_m:
            reason = f"{'xyz'[axis]} = {1e3 * p[axis]:.1f} mm is not yet {1e3 * inset_m:g} mm inside {1e3 * limit:g} mm"
        violation = Violation(
            self.name, self.severity, self.arm, reason, view.now_ns, value=p[axis], limit=limit, unit="m"
        )
        outward = [
            0.0 if excess <= 0.0 else excess if x - b > a - x else -excess
            for excess, x, a, b in zip(out, p, low, high, strict=True)
        ]
        return _judge(violation, self._way_back(arm, outward), past)

    def _way_back(self, arm: ArmView, outward: list[float]) -> WayBack:
        twist = arm.commanded_twist()
        if twist is None:
            return _NO_WAY
        R, lever_m = arm.state.value.T_base_tcp[:3, :3], self.T_tcp_point[:3, 3]
        v = point_velocity(twist, R, lever_m)
        # Along each axis: one that is left alone would keep it outside.
        if any(out and -math.copysign(1.0, out) * part < REST_M_S for out, part in zip(outward, v, strict=True)):
            return _NO_WAY
        size = math.hypot(*outward)
        measured = point_velocity(arm.state.value.twist, R, lever_m)
        inward = -sum(out * part for out, part in zip(outward, v, strict=True)) / size
        measured_inward = -sum(out * part for out, part in zip(outward, measured, strict=True)) / size
        return WayBack(inward, math.hypot(*v), measured_inward, REST_M_S)


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

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation while the axis is outside the cone, unless it comes back."""
        arm = view.arms[self.arm]
        axis = arm.state.value.T_base_tcp[:3, :3] @ self.axis_tcp
        tilt_rad = math.acos(max(-1.0, min(1.0, float(axis @ self.direction))))
        limit_rad = LEAVE * self.limit_rad if _OUT in past else self.limit_rad
        if tilt_rad <= limit_rad:
            return None, NO_MARKS
        reason = f"tilted by {math.degrees(tilt_rad):.1f} deg, limit {math.degrees(limit_rad):g} deg"
        violation = Violation(
            self.name, self.severity, self.arm, reason, view.now_ns, value=tilt_rad, limit=limit_rad, unit="rad"
        )
        way = _NO_WAY
        if (twist := arm.commanded_twist()) is not None:
            measured_inward, _ = self._inward(arm.state.value.twist, axis, tilt_rad)
            way = WayBack(*self._inward(twist, axis, tilt_rad), measured_inward, REST_RAD_S)
        return _judge(violation, way, past)

    def _inward(self, twist: Array, axis: Array, tilt_rad: float) -> tuple[float, float]:
        """Return the rates at which a twist turns the axis into the cone, and at all, rad/s."""
        turning = np.cross(twist[3:], axis)
        return float(turning @ self.direction) / max(math.sin(tilt_rad), 1e-9), math.sqrt(float(turning @ turning))


class WorkspaceConfig(GradedSettings):
    """Box for a sensor, or for the tool centre point of an arm without one, along the axes of the arm's base.

    ``margin_mm`` is the free space around the box: a cell whose stopping distance may exceed it is refused. A point
    that was outside counts as inside again a fifth of the margin inside the box.

    Attributes:
        arm: role of the arm.
        sensor: role of the sensor whose tip stays inside; none for the tool centre point of an arm without one.
        min_mm: lower corner of the box in the arm's base frame.
        max_mm: upper corner of the box.
        margin_mm: free space around the box: a cell whose stopping distance may exceed it is refused.
    """

    kind: Literal["workspace"]
    arm: str
    sensor: str | None = None
    min_mm: tuple[float, float, float]
    max_mm: tuple[float, float, float]
    margin_mm: PositiveFloat

    @model_validator(mode="after")
    def _corners_in_order(self) -> WorkspaceConfig:
        if not all(low < high for low, high in zip(self.min_mm, self.max_mm, strict=True)):
            raise ValueError(f"min_mm {list(self.min_mm)} is not below max_mm {list(self.max_mm)} in every axis")
        return self

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return the guarded point beyond each wall, wherever the arm can take it."""
        if (problem := _guard_problem(self.arm, self.sensor, facts)) is not None:
            yield problem
            return
        T_tcp_point = np.eye(4) if self.sensor is None else facts.sensors[self.sensor].T_tcp_sensor
        reach_m = facts.arms[self.arm].reach_m + float(np.linalg.norm(T_tcp_point[:3, 3]))
        low, high = np.array(self.min_mm), np.array(self.max_mm)
        inside = _placed(self.arm, 0.5e-3 * (low + high), T_tcp_point)
        covers = (self.arm,) if self.sensor is None else (self.arm, self.sensor)
        for axis in range(3):
            for key, wall_mm, sign in (("min_mm", low[axis], -1.0), ("max_mm", high[axis], 1.0)):
                place_mm = np.clip(0.0, low, high)
                place_mm[axis] = wall_mm
                what = f"{'xyz'[axis]} = {wall_mm + sign * self.margin_mm:g} mm"
                if 1e-3 * np.linalg.norm(place_mm) > reach_m:
                    reason = f"its wall at {'xyz'[axis]} = {wall_mm:g} mm is out of the arm's reach of {reach_m:.2f} m"
                    yield CannotTrip(self.arm, reason, key, "move the wall to where the arm must not pass")
                    continue
                place_mm[axis] += sign * self.margin_mm
                outside = _placed(self.arm, 1e-3 * place_mm, T_tcp_point)
                yield Fault(self.arm, what, f"{wall_mm:g} mm", outside, inside, covers=covers, key=key)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Workspace`` interlock. Raises ConfigError for a sensor that the cell does not have."""
        T_tcp_point = _guarded(name, self.sensor, T_tcp_sensor)
        min_m, max_m = 1e-3 * np.array(self.min_mm), 1e-3 * np.array(self.max_mm)
        # A box that is thinner than its margin still has an inside.
        leave_m = min((1.0 - LEAVE) * 1e-3 * self.margin_mm, 0.25 * float(np.min(max_m - min_m)))
        return Workspace(name, self.level, self.arm, T_tcp_point, min_m, max_m, leave_m)


class TiltConfig(GradedSettings):
    """Cone for the z axis of a sensor, or of the tool of an arm without one; ``direction`` is along base axes.

    Attributes:
        arm: role of the arm.
        sensor: role of the sensor whose axis stays in the cone; none for the tool's.
        direction: axis of the cone along base axes.
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

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return the guarded axis tilted out of the cone."""
        if (problem := _guard_problem(self.arm, self.sensor, facts)) is not None:
            yield problem
            return
        axis_tcp = np.array([0.0, 0.0, 1.0])
        if self.sensor is not None:
            axis_tcp = facts.sensors[self.sensor].T_tcp_sensor[:3, 2]
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        tilt_deg = just_beyond(self.limit_deg, 180.0)
        covers = (self.arm,) if self.sensor is None else (self.arm, self.sensor)
        yield Fault(
            self.arm,
            f"tilted by {tilt_deg:.1f} deg",
            f"{self.limit_deg:g} deg",
            _pointed(self.arm, axis_tcp, direction, math.radians(tilt_deg)),
            _pointed(self.arm, axis_tcp, direction, 0.0),
            covers=covers,
            key="limit_deg",
            hint="lower it below 180 deg",
        )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Tilt`` interlock. Raises ConfigError for a sensor that the cell does not have."""
        axis = _guarded(name, self.sensor, T_tcp_sensor)[:3, 2]
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        return Tilt(name, self.level, self.arm, axis, direction, math.radians(self.limit_deg))


def _guard_problem(arm: str, sensor: str | None, facts: CellFacts) -> CannotTrip | None:
    """Return why an arm's tool, or a sensor on it, is not what has to be guarded; None if it is."""
    if sensor is not None:
        return mount_problem(sensor, arm, facts, "sensor")
    if (problem := role_problem(arm, facts.arms, "arm", "arm")) is not None:
        return problem
    carried = sorted(role for role, each in facts.sensors.items() if each.arm == arm)
    if not carried:
        return None
    return CannotTrip(arm, f"it guards the tool, and {carried[0]} at its end is not guarded", "sensor", "name it")


def _placed(arm: str, place_m: Array, T_tcp_point: Array) -> Change:
    """Return the change that puts a point of an arm's tool at ``place_m`` (3,) in its base's frame."""
    T_base_point = se3.exp(np.concatenate([place_m, np.zeros(3)]))
    T_base_tcp = T_base_point @ se3.inverse(T_tcp_point)
    return lambda view, t_s: with_motion(view, arm, T_base_tcp)


def _pointed(arm: str, axis_tcp: Array, direction: Array, tilt_rad: float) -> Change:
    """Return the change that tilts an axis of an arm's tool out of a direction along base axes."""
    R_axis, R_direction = _frame_along(axis_tcp), _frame_along(direction)
    tilted = se3.exp(np.array([0.0, 0.0, 0.0, tilt_rad, 0.0, 0.0]))[:3, :3]
    T_base_tcp = np.eye(4)
    T_base_tcp[:3, :3] = R_direction @ tilted @ R_axis.T
    return lambda view, t_s: with_motion(view, arm, T_base_tcp)


def _frame_along(axis: Array) -> Array:
    """Return a rotation (3, 3) whose z axis is ``axis`` (3,)."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    frame: Array = np.stack([x, np.cross(axis, x), axis], axis=1)
    return frame


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


WORKSPACE = InterlockSpec("workspace", "sensor or tool stays inside a box in the arm's base frame", WorkspaceConfig)
TILT = InterlockSpec("tilt", "sensor or tool points along a direction within a cone", TiltConfig)
