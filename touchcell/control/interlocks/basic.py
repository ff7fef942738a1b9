"""Interlocks that every cell needs: finite numbers, speed, depth, and age of the measurements."""

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
    """Largest speeds of any tool centre point."""

    kind: Literal["tcp_speed"]
    limit_m_s: PositiveFloat
    limit_rad_s: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``TcpSpeed`` interlock."""
        return TcpSpeed(name, self.level, self.limit_m_s, self.limit_rad_s)


class DepthConfig(GradedSettings):
    """Largest indentation of any sensor."""

    kind: Literal["depth"]
    limit_mm: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Depth`` interlock."""
        return Depth(name, self.level, 1e-3 * self.limit_mm)


class FrameAgeConfig(InterlockSettings):
    """Largest age of a tactile frame."""

    kind: Literal["frame_age"]
    limit_ms: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``FrameAge`` interlock."""
        return FrameAge(name, self.level, 1e-3 * self.limit_ms, tuple(sorted(T_tcp_sensor)))


class ArmStateAgeConfig(SpatialInterlockConfig):
    """Largest age of an arm state."""

    kind: Literal["arm_state_age"]
    limit_ms: PositiveFloat

    def build_in_scene(self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene) -> Interlock:
        """Return the ``ArmStateAge`` interlock."""
        return ArmStateAge(name, self.level, 1e-3 * self.limit_ms, tuple(sorted(planning_scene.T_world_base)))
