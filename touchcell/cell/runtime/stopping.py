"""Stopping all arms of a cell together, watching each until it stands, and doing more about one that does not.

Categories are those of IEC 60204-1. The cell file names one for each arm; an arm that is not at rest within the time
that its deceleration takes, and a margin, is stopped once more by the strongest category that its driver offers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.control.interlocks.boundary import REST_M_S
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.protocols import ServoArm, StopCategory
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import described
from touchcell.geometry.types import Array

STOP_MARGIN_S: Final = 0.1
"""What a stop may take beyond the deceleration itself: latency, and a controller that rounds its corners."""


@dataclass(frozen=True, slots=True)
class StopReport:
    """How one arm came to rest.

    Attributes:
        category: by which it was commanded to stop first.
        speed_m_s: of its tool centre point when it was commanded to; None where it could not be read.
        time_s: until it stood; None if it never did.
        distance_m: farthest way from where it was told; None where it could not be read.
        declared_s, declared_m: what it may take.
        escalated: whether the strongest category had to be used.
        problem: why it could not be watched, if so.
    """

    category: StopCategory
    speed_m_s: float | None
    time_s: float | None
    distance_m: float | None
    declared_s: float
    declared_m: float
    escalated: bool = False
    problem: str = ""

    @property
    def kept(self) -> bool:
        """Whether it stood within the declared time and distance, as far as the distance could be read."""
        in_time = self.time_s is not None and self.time_s <= self.declared_s
        return in_time and (self.distance_m is None or self.distance_m <= self.declared_m)


def declared_stop(speed_m_s: float, accel_m_s2: float, margin_s: float = STOP_MARGIN_S) -> tuple[float, float]:
    """Time (s) and distance (m) that a stop from ``speed_m_s`` may take: v/a and v^2/2a, and the margin at speed."""
    braking_s = speed_m_s / accel_m_s2
    return braking_s + margin_s, 0.5 * speed_m_s * braking_s + speed_m_s * margin_s


@dataclass(slots=True)
class _Stopping:
    """One arm on its way to rest."""

    arm: ServoArm
    category: StopCategory
    told_ns: int
    start: Array | None
    speed_m_s: float | None
    declared_s: float
    declared_m: float
    deadline_ns: int
    farthest_m: float | None = None
    escalated: bool = False
    rest_ns: int | None = None
    problem: str = ""

    def report(self) -> StopReport:
        time_s = None if self.rest_ns is None else (self.rest_ns - self.told_ns) * 1e-9
        return StopReport(
            self.category,
            self.speed_m_s,
            time_s,
            self.farthest_m,
            self.declared_s,
            self.declared_m,
            self.escalated,
            self.problem,
        )


class Stopper:
    """Stops the arms of one cell.

    Args:
        arms: by role.
        categories: the one for each role when motion has to end.
        holding: roles of arms that hold something against another: they keep their power unless they are themselves
            what is wrong.
        clock: injected time.
        period_s: how often the arms are looked at until they stand.
    """

    def __init__(
        self,
        arms: Mapping[str, ServoArm],
        categories: Mapping[str, StopCategory],
        clock: Clock,
        period_s: float,
        holding: Collection[str] = (),
    ) -> None:
        self._arms = arms
        self._holding = frozenset(holding)
        self._categories = categories
        self._clock = clock
        self._period_ns = round(1e9 * period_s)
        self._stopping: dict[str, _Stopping] = {}

    def stop(self, *, tripped: bool, distrusted: Collection[str] = ()) -> Mapping[str, BaseException]:
        """Command every arm to stop, whatever the drivers of others raise; returns what was raised, by role.

        Args:
            tripped: whether something is wrong; an arm whose work is merely done stops and holds.
            distrusted: roles of arms that can no longer be trusted and get the strongest category that they offer.
        """
        failed: dict[str, BaseException] = {}
        told: dict[str, StopCategory] = {}
        for role, arm in self._arms.items():
            told[role] = StopCategory.STOP_AND_HOLD
            if role in distrusted:
                told[role] = _strongest(arm)
            elif tripped and role not in self._holding:
                told[role] = self._categories.get(role, StopCategory.STOP_AND_HOLD)
            try:
                arm.stop(told[role])
            except BaseException as error:
                # Whatever it is: the next arm has to be told now.
                failed[role] = error
        # Measured only now: reading one arm must not delay the stop of the next.
        for role, category in told.items():
            if role not in self._stopping:
                self._stopping[role] = self._begin(self._arms[role], category)
        return failed

    def watch(
        self,
        on_state: Callable[[str, Stamped[TcpState]], None],
        on_escalation: Callable[[str, StopReport, float], None],
    ) -> Mapping[str, StopReport]:
        """Watch every stopping arm until it stands or has had its time twice over; returns a report for each.

        Args:
            on_state: called with every state that is read on the way.
            on_escalation: called with the time (s) that it was given when an arm has not come to rest, or cannot be
                seen at rest, before it is stopped by stronger means.
        """
        while pending := {role: s for role, s in self._stopping.items() if s.rest_ns is None and not s.problem}:
            for role, stopping in pending.items():
                self._look(role, stopping, on_state, on_escalation)
            if any(s.rest_ns is None and not s.problem for s in pending.values()):
                self._clock.sleep_until_ns(self._clock.now_ns() + self._period_ns)
        reports = {role: stopping.report() for role, stopping in self._stopping.items()}
        self._stopping.clear()
        return reports

    def _begin(self, arm: ServoArm, category: StopCategory) -> _Stopping:
        now_ns, start, speed_m_s = self._clock.now_ns(), None, None
        try:
            limits = arm.limits
        except BaseException as error:
            problem = f"cannot be watched, for its limits are not known: {described(error)}"
            return _Stopping(arm, category, now_ns, None, None, 0.0, 0.0, now_ns, problem=problem)
        # An arm that cannot tell its speed is given the time that its fastest motion would need.
        linear_m_s, angular_rad_s, age_s = limits.speed_m_s, limits.rot_speed_rad_s, 0.0
        try:
            sample = arm.tcp()
        except BaseException:
            sample = None
        if sample is not None and self._tells(sample, now_ns):
            state, age_s = sample.value, max(0.0, sample.age_s(now_ns))
            start, speed_m_s = state.T_base_tcp[:3, 3].copy(), math.hypot(*state.twist[:3])
            linear_m_s = _by_now(speed_m_s, limits.accel_m_s2 * age_s, limits.speed_m_s)
            angular_rad_s = _by_now(math.hypot(*state.twist[3:]), limits.rot_accel_rad_s2 * age_s, angular_rad_s)
        declared_s, declared_m = declared_stop(linear_m_s, limits.accel_m_s2)
        # The way is measured from where the state was, so what it moved since counts too. Positions of an arm that
        # stands are as noisy as what counts as standing.
        declared_m = max(declared_m + linear_m_s * age_s, REST_M_S * STOP_MARGIN_S)
        declared_s = max(declared_s, angular_rad_s / limits.rot_accel_rad_s2 + STOP_MARGIN_S)
        deadline_ns = now_ns + round(1e9 * declared_s)
        return _Stopping(arm, category, now_ns, start, speed_m_s, declared_s, declared_m, deadline_ns)

    def _tells(self, state: Stamped[TcpState], now_ns: int) -> bool:
        """Whether a state says where its arm is now: it is finite and not much older than a cycle."""
        finite = np.isfinite(state.value.T_base_tcp).all() and np.isfinite(state.value.twist).all()
        return bool(finite) and now_ns - state.t_ns <= 2 * self._period_ns

    def _look(
        self,
        role: str,
        stopping: _Stopping,
        on_state: Callable[[str, Stamped[TcpState]], None],
        on_escalation: Callable[[str, StopReport, float], None],
    ) -> None:
        now_ns, arm = self._clock.now_ns(), stopping.arm
        unseen = ""
        try:
            state = arm.tcp()
            on_state(role, state)
            if stopping.start is not None and self._tells(state, now_ns):
                way_m = math.dist(state.value.T_base_tcp[:3, 3], stopping.start)
                stopping.farthest_m = max(stopping.farthest_m or 0.0, way_m)
            if arm.at_rest():
                stopping.rest_ns = now_ns
                return
        except DeviceError as error:
            # An arm that cannot be seen is not known to stand.
            unseen = str(error)
        except BaseException as error:
            unseen = f"its driver raised {described(error)}"
        if now_ns < stopping.deadline_ns:
            return
        if stopping.escalated:
            stopping.problem = (
                unseen or "does not come to rest by any means that its driver has: use the emergency stop"
            )
            return
        stopping.escalated = True
        stopping.deadline_ns = now_ns + round(1e9 * stopping.declared_s)
        on_escalation(role, stopping.report(), (now_ns - stopping.told_ns) * 1e-9)
        # It has its second deadline all the same.
        with suppress(BaseException):
            arm.stop(_strongest(arm))


def _by_now(measured: float, gained: float, limit: float) -> float:
    """Return the largest speed that an arm may have now, which has gained at most so much since it was measured."""
    return max(measured, min(measured + gained, limit))


def _strongest(arm: ServoArm) -> StopCategory:
    """The strongest category that an arm offers; one that cannot be asked is commanded to stop and hold."""
    try:
        return min(arm.stop_categories)
    except BaseException:
        return StopCategory.STOP_AND_HOLD
