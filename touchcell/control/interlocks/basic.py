"""Interlocks that every cell needs: finite numbers, speed, depth, and age of the measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.control.interlocks.coverage import (
    RUNAWAY,
    SILENCE_S,
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    SensorFacts,
    just_beyond,
    of_each_sensor,
    with_arm,
    with_motion,
    with_sensor,
)
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.planning_scene import PlanningScene, SpatialInterlockConfig
from touchcell.control.interlocks.settings import LEAVE, GradedSettings, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import NO_MARKS, InterlockState, Judgement, TimedInterlock, TimerState
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Finite:
    """Require every number in the view and in the commands to be finite. Always on, and checked first."""

    name: str = "finite"
    severity: Severity = Severity.FAULT

    def check(self, view: CellView) -> Violation | None:
        # A sum of floats is finite only if all of them are; one that overflows is looked at below like any other.
        total = 0.0
        for _, _, _, value in self._numbers(view):
            total += value if isinstance(value, float) else sum(np.asarray(value).ravel().tolist())
        if math.isfinite(total):
            return None
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
            if arm.wrench is not None:
                yield role, None, "measured wrench", arm.wrench.value
            if arm.external_torque is not None:
                yield role, None, "external torque", arm.external_torque.value
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


@dataclass(frozen=True, slots=True)
class TcpSpeed:
    """Limit the measured and the commanded speed of every tool centre point, with hysteresis down to 80 %."""

    name: str
    severity: Severity
    limit_m_s: float
    limit_rad_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the arm that exceeds a limit by the largest factor, measured or commanded."""
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
    """Limit the indentation of every sensor, with hysteresis down to 80 %."""

    name: str
    severity: Severity
    limit_m: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the deepest of the sensors that are too deep."""
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
    """Limit the age of every sensor's newest frame; a stamp in the future and a missing sensor are violations too."""

    name: str
    severity: Severity
    limit_s: float
    sensors: tuple[str, ...] = ()

    def check(self, view: CellView) -> Violation | None:
        """Return a violation for a sensor that is not in the view, or for the one with the oldest frame."""
        for role in self.sensors:
            if role not in view.sensors:
                return _missing(self, "frame", role, view.now_ns)
        stamps = [(sensor.t_frame_ns, role, sensor.seq) for role, sensor in view.sensors.items()]
        return _check_ages(self, "newest frame", stamps, view.now_ns)


@dataclass(frozen=True, slots=True)
class ArmStateAge:
    """Limit the age of every arm's newest state; a stamp in the future and a missing arm are violations too."""

    name: str
    severity: Severity
    limit_s: float
    arms: tuple[str, ...] = ()

    def check(self, view: CellView) -> Violation | None:
        """Return a violation for an arm that is not in the view, or for the one with the oldest state."""
        for role in self.arms:
            if role not in view.arms:
                return _missing(self, "state", role, view.now_ns)
        stamps = [(arm.state.t_ns, role, None) for role, arm in view.arms.items()]
        return _check_ages(self, "newest state", stamps, view.now_ns)

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield the age of each arm's newest state."""
        for role, arm in view.arms.items():
            yield Level(role, 1e-6 * (view.now_ns - arm.state.t_ns), 1e3 * self.limit_s, "ms")


def _missing(rule: FrameAge | ArmStateAge, what: str, role: str, now_ns: int) -> Violation:
    reason = f"there is no {what} of it in this cycle"
    return Violation(rule.name, rule.severity, role, reason, now_ns, limit=rule.limit_s, unit="s")


def _check_ages(
    rule: FrameAge | ArmStateAge, what: str, stamps: Sequence[tuple[int, str, int | None]], now_ns: int
) -> Violation | None:
    """Return a violation for the oldest of ``stamps`` (time, role and frame number), or for one in the future."""
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


class TcpSpeedConfig(InterlockSettings):
    """Largest speeds of any tool centre point.

    Attributes:
        limit_m_s: largest linear speed, commanded and measured.
        limit_rad_s: largest angular speed, likewise.
    """

    kind: Literal["tcp_speed"]
    limit_m_s: PositiveFloat
    limit_rad_s: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return arms that run away, linearly and in rotation, as measured and as commanded."""
        for role, arm in facts.arms.items():
            if arm.limits is None:
                continue
            for first, key, limit, gate, unit in (
                (0, "limit_m_s", self.limit_m_s, arm.limits.speed_m_s, "m/s"),
                (3, "limit_rad_s", self.limit_rad_s, arm.limits.rot_speed_rad_s, "rad/s"),
            ):
                speed = just_beyond(limit, RUNAWAY * gate)
                twist = np.zeros(6)
                twist[first] = speed
                for source in ("measured", "commanded"):
                    yield Fault(
                        role,
                        f"{source} speed {speed:.3g} {unit}",
                        f"{limit:g} {unit}",
                        _runs_away(role, twist, source),
                        key=key,
                        hint=f"lower it below {RUNAWAY:g} times the {gate:g} {unit} of this arm's gate",
                    )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``TcpSpeed`` interlock."""
        return TcpSpeed(name, self.level, self.limit_m_s, self.limit_rad_s)


def _runs_away(role: str, twist: Array, source: str) -> Change:
    def change(view: CellView, t_s: float) -> CellView:
        if source == "measured":
            return with_motion(view, role, twist=twist)
        return with_arm(view, role, command=TwistCommand(twist, TwistFrame.BASE, view.now_ns, 0.03))

    return change


class DepthConfig(GradedSettings):
    """Largest indentation of any sensor.

    Attributes:
        limit_mm: largest indentation.
    """

    kind: Literal["depth"]
    limit_mm: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor pressed in too deep, as far as its estimator can report."""

        def pressed(role: str, sensor: SensorFacts) -> Fault:
            depth_m = just_beyond(1e-3 * self.limit_mm, sensor.depth_m)
            return Fault(
                role,
                f"pressed in by {1e3 * depth_m:.2f} mm",
                f"{self.limit_mm:g} mm",
                lambda view, t_s: with_sensor(view, role, in_contact=True, depth_m=depth_m),
                key="limit_mm",
                hint=f"lower it: {sensor.estimator} reports {1e3 * sensor.depth_m:.2f} mm at most",
            )

        return of_each_sensor(facts, lambda sensor: sensor.depth_m > 0.0, "reports no depth", pressed)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Depth`` interlock."""
        return Depth(name, self.level, 1e-3 * self.limit_mm)


class FrameAgeConfig(InterlockSettings):
    """Largest age of a tactile frame.

    Attributes:
        limit_ms: oldest tactile frame that is accepted.
    """

    kind: Literal["frame_age"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each sensor silent, and missing."""
        if not facts.sensors:
            yield CannotTrip("", "the task has no tactile sensor")
        for role in facts.sensors:
            yield _silence(role, "sensors", self.limit_ms)
            yield _absence(role, "sensors", self.limit_ms)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``FrameAge`` interlock."""
        return FrameAge(name, self.level, 1e-3 * self.limit_ms, tuple(sorted(T_tcp_sensor)))


class ArmStateAgeConfig(SpatialInterlockConfig):
    """Largest age of an arm state.

    Attributes:
        limit_ms: largest age; an arm that is missing is a violation too.
    """

    kind: Literal["arm_state_age"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each arm silent, and missing."""
        if not facts.arms:
            yield CannotTrip("", "the task has no arm")
        for role in facts.arms:
            yield _silence(role, "arms", self.limit_ms)
            yield _absence(role, "arms", self.limit_ms)

    def build_in_scene(self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene) -> Interlock:
        """Return the ``ArmStateAge`` interlock."""
        return ArmStateAge(name, self.level, 1e-3 * self.limit_ms, tuple(sorted(planning_scene.T_world_base)))


def _silence(role: str, group: Literal["arms", "sensors"], limit_ms: float) -> Fault:
    def change(view: CellView, t_s: float) -> CellView:
        t_ns = view.now_ns - round(1e9 * t_s)
        if group == "sensors":
            return with_sensor(view, role, t_frame_ns=t_ns)
        return with_arm(view, role, state=replace(view.arms[role].state, t_ns=t_ns))

    hint = f"lower it below {1e3 * SILENCE_S:g} ms"
    return Fault(role, "silent", f"{limit_ms:g} ms", change, within_s=SILENCE_S, key="limit_ms", hint=hint)


def _absence(role: str, group: Literal["arms", "sensors"], limit_ms: float) -> Fault:
    def change(view: CellView, t_s: float) -> CellView:
        if group == "sensors":
            return replace(view, sensors={key: each for key, each in view.sensors.items() if key != role})
        return replace(view, arms={key: each for key, each in view.arms.items() if key != role})

    return Fault(role, "missing", f"{limit_ms:g} ms", change, within_s=SILENCE_S)


TCP_SPEED = InterlockSpec("tcp_speed", "measured and commanded tool speed stay below limits", TcpSpeedConfig)
DEPTH = InterlockSpec("depth", "no sensor is pressed in too deep", DepthConfig)
FRAME_AGE = InterlockSpec("frame_age", "tactile frames are fresh", FrameAgeConfig)
ARM_STATE_AGE = InterlockSpec("arm_state_age", "arm states are fresh", ArmStateAgeConfig)
