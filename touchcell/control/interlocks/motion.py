"""Interlocks on how an arm follows its commands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from touchcell.control.interlocks.coverage import (
    HELD_S,
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    just_beyond,
    with_arm,
    with_motion,
)
from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.settings import LEAVE, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import (
    InterlockState,
    Judgement,
    OnDelay,
    Reading,
    Sustained,
    TimedInterlock,
    TimerState,
)
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry import se3
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Standstill:
    """Require an arm that was commanded to stop to stay at rest.

    Its reference is where it stood ``settle_s`` after the stop or after its latest violation.
    """

    name: str
    severity: Severity
    limit_m: float
    settle_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the first arm that has drifted too far."""
        marks: dict[str, TimerState] = {}
        found: Violation | None = None
        for role, arm in view.arms.items():
            if arm.sent is not None:
                continue
            position = arm.state.value.T_base_tcp[:3, 3]
            mark = past.get(role, TimerState(view.now_ns))
            if not mark.values and view.now_ns - mark.since_ns >= round(1e9 * self.settle_s):
                mark = TimerState(mark.since_ns, values=tuple(position.tolist()))
            drift_m = math.dist(position, mark.values) if mark.values else 0.0
            # The reference is reset after a violation, or the latch could never be reset.
            marks[role] = TimerState(view.now_ns) if drift_m > self.limit_m else mark
            if found is None and drift_m > self.limit_m:
                reason = f"drifted by {1e3 * drift_m:.2f} mm while commanded to stop, limit {1e3 * self.limit_m:g} mm"
                found = Violation(
                    self.name, self.severity, role, reason, view.now_ns, value=drift_m, limit=self.limit_m, unit="m"
                )
        return found, marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield how far each arm that has been commanded to stop has drifted."""
        for role, arm in view.arms.items():
            mark = past.get(role)
            drift_m = math.dist(arm.state.value.T_base_tcp[:3, 3], mark.values) if mark and mark.values else 0.0
            yield Level(role, 1e3 * drift_m, 1e3 * self.limit_m, "mm")


def _tracking_errors(view: CellView) -> Iterator[Reading]:
    for role, arm in view.arms.items():
        if arm.sent is not None:
            error = arm.state.value.twist[:3] - arm.sent.command.twist[:3]
            yield Reading(role, 1e3 * math.sqrt(float(error @ error)))


def _limited(view: CellView) -> Mapping[str, str]:
    return {
        role: f"limited by its gate ({', '.join(adjustment.limit for adjustment in arm.sent.adjustments)})"
        for role, arm in view.arms.items()
        if arm.sent is not None and arm.sent.limited
    }


_LIMITED_S = 10.0
"""A gate that limits for this long must trip."""


def _creeps(role: str, speed_m_s: float) -> Change:
    def change(view: CellView, t_s: float) -> CellView:
        return with_motion(view, role, se3.exp(np.array([speed_m_s * t_s, 0.0, 0.0, 0.0, 0.0, 0.0])))

    return change


def _sent(role: str, speed_m_s: float, adjustments: tuple[Adjustment, ...] = ()) -> Change:
    twist = np.array([speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0])

    def change(view: CellView, t_s: float) -> CellView:
        command = TwistCommand(twist, TwistFrame.BASE, view.now_ns, 0.03)
        return with_arm(view, role, sent=Sent(command, view.now_ns, adjustments))

    return change


class StandstillConfig(InterlockSettings):
    """Largest drift of an arm that is commanded to stop, and the time that it may take to come to rest.

    Attributes:
        limit_mm: largest drift.
        settle_ms: time to come to rest after a stop.
    """

    kind: Literal["standstill"]
    limit_mm: PositiveFloat
    settle_ms: NonNegativeFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each arm that moves on although commanded to stop."""
        for role, arm in facts.arms.items():
            if arm.limits is None:
                continue
            yield Fault(
                role,
                f"moves on at {1e3 * arm.limits.speed_m_s:g} mm/s",
                f"{self.limit_mm:g} mm",
                _creeps(role, arm.limits.speed_m_s),
                before_s=1e-3 * self.settle_ms if self.settle_ms <= 1e3 * HELD_S else HELD_S,
                key="limit_mm",
                hint=f"lower it, and settle_ms below {1e3 * HELD_S:g}: within {HELD_S:g} s the arm gets "
                f"{1e3 * HELD_S * arm.limits.speed_m_s:.0f} mm far",
            )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Standstill`` interlock."""
        return Standstill(name, self.level, 1e-3 * self.limit_mm, 1e-3 * self.settle_ms)


class TrackingConfig(InterlockSettings):
    """Largest difference between commanded and measured velocity, and how long it may be exceeded.

    Attributes:
        limit_mm_s: largest difference of the velocities.
        leave_mm_s: difference below which the time starts anew; none for a share of the limit.
        hold_ms: how long it may be exceeded.
    """

    kind: Literal["tracking"]
    limit_mm_s: PositiveFloat
    leave_mm_s: PositiveFloat | None = None
    hold_ms: NonNegativeFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each arm that stays at rest although commanded."""
        for role, arm in facts.arms.items():
            if arm.limits is None:
                continue
            speed_m_s = just_beyond(1e-3 * self.limit_mm_s, arm.limits.speed_m_s)
            yield Fault(
                role,
                f"at rest, commanded at {1e3 * speed_m_s:.3g} mm/s",
                f"{self.limit_mm_s:g} mm/s",
                _sent(role, speed_m_s),
                key="limit_mm_s",
                hint=f"lower it below the {1e3 * arm.limits.speed_m_s:g} mm/s of this arm's gate",
            )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on the velocity error."""
        leave, hold_s = self.leave_mm_s or LEAVE * self.limit_mm_s, 1e-3 * self.hold_ms
        return Sustained(
            name, self.level, _tracking_errors, "off what was sent by", self.limit_mm_s, leave, "mm/s", hold_s
        )


class LimitedConfig(InterlockSettings):
    """Longest time for which an arm's gate may limit the task's commands.

    Attributes:
        limit_ms: longest time.
    """

    kind: Literal["limited"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each arm whose gate limits every command."""
        for role, arm in facts.arms.items():
            if arm.limits is None:
                continue
            speed = arm.limits.speed_m_s
            yield Fault(
                role,
                "limited by its gate",
                f"{self.limit_ms:g} ms",
                _sent(role, speed, (Adjustment("tcp linear speed", 2.0 * speed, speed),)),
                within_s=_LIMITED_S,
                key="limit_ms",
                hint=f"lower it below {1e3 * _LIMITED_S:g} ms",
            )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on limited commands."""
        return OnDelay(name, self.level, _limited, 1e-3 * self.limit_ms)


TRACKING = InterlockSpec("tracking", "an arm follows its commanded velocity", TrackingConfig)
STANDSTILL = InterlockSpec("standstill", "an arm that is commanded to stop stays at rest", StandstillConfig)
LIMITED = InterlockSpec("limited", "no gate limits an arm's command for long", LimitedConfig)
