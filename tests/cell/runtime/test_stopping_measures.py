"""What is measured of a stop: of arms that move, are silent, or lie as a script says."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.cell.runtime.stopping import STOP_MARGIN_S, Stopper, StopReport
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.errors import TransportTimeout
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.protocols import StopCategory
from touchcell.drivers.core.samples import Stamped, TcpState

HOLD = StopCategory.STOP_AND_HOLD
PERIOD_NS = 10_000_000
MARGIN_NS = round(1e9 * STOP_MARGIN_S)


class Scripted:
    """An arm whose place and speed are functions of time (s), and which stands from some time on."""

    name = "arm"
    stop_categories = frozenset(StopCategory)
    limits = TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0)

    def __init__(
        self,
        clock: VirtualClock,
        rest_s: float = math.inf,
        x_m: Callable[[float], float] = lambda t_s: 0.0,
        twist: tuple[float, ...] = (0.0,) * 6,
        age_ns: int = 0,
        silent: Callable[[float], bool] = lambda t_s: False,
    ) -> None:
        self._clock, self._rest_s, self._x_m, self._silent = clock, rest_s, x_m, silent
        self.twist, self.age_ns = np.array(twist), age_ns
        self.stops: list[tuple[int, StopCategory]] = []
        self.read_ns: list[int] = []

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        now_ns = self._clock.now_ns()
        if self._silent(1e-9 * now_ns):
            raise TransportTimeout("arm", "state", 0.1)
        self.read_ns.append(now_ns)
        T = np.eye(4)
        T[0, 3] = self._x_m(1e-9 * now_ns)
        return Stamped(TcpState(T, self.twist), now_ns - self.age_ns, 1)

    def at_rest(self) -> bool:
        return 1e-9 * self._clock.now_ns() >= self._rest_s

    def stop(self, category: StopCategory) -> None:
        self.stops.append((self._clock.now_ns(), category))


def stopper(arms: Mapping[str, Any], clock: VirtualClock) -> Stopper:
    return Stopper(arms, dict.fromkeys(arms, HOLD), clock, 1e-9 * PERIOD_NS)


def watched(machine: Stopper) -> Mapping[str, StopReport]:
    return machine.watch(lambda role, state: None, lambda role, report, waited_s: None)


def stopped(arm: Scripted, clock: VirtualClock) -> StopReport:
    machine = stopper({"arm": arm}, clock)
    machine.stop(tripped=True)
    return watched(machine)["arm"]


def report(time_s: float | None, distance_m: float | None) -> StopReport:
    return StopReport(HOLD, 0.1, time_s, distance_m, 0.3, 0.02)


@pytest.mark.parametrize(
    ("time_s", "distance_m", "kept"),
    [
        (0.3, 0.02, True),
        (0.1, None, True),
        (0.30001, 0.0, False),
        (0.1, 0.0201, False),
        (0.31, None, False),
        (None, 0.0, False),
        (None, None, False),
    ],
)
def test_a_stop_is_kept_that_ends_within_the_declared_time_and_distance(
    time_s: float | None, distance_m: float | None, kept: bool
) -> None:
    assert report(time_s, distance_m).kept is kept


def test_an_arm_that_turns_has_the_time_in_which_its_rotation_stops() -> None:
    clock = VirtualClock()
    turning = stopped(Scripted(clock, 0.0, twist=(0.01, 0.0, 0.0, 0.0, 0.0, 0.5)), clock)
    assert turning.speed_m_s == pytest.approx(0.01)
    assert turning.declared_s == pytest.approx(0.5 / 2.5 + STOP_MARGIN_S)
    assert turning.declared_m == pytest.approx(0.5 * 0.01 * 0.02 + 0.01 * STOP_MARGIN_S)
    slowly = stopped(Scripted(clock, 0.0, twist=(0.05, 0.0, 0.0, 0.1, 0.0, 0.0)), clock)
    assert slowly.speed_m_s == pytest.approx(0.05)
    assert slowly.declared_s == pytest.approx(0.1 + STOP_MARGIN_S)


@pytest.mark.parametrize(("age_ns", "speed_m_s"), [(0, 0.05), (2 * PERIOD_NS, 0.05), (2 * PERIOD_NS + 1, None)])
def test_a_state_older_than_two_cycles_tells_no_speed(age_ns: int, speed_m_s: float | None) -> None:
    clock = VirtualClock()
    arm = Scripted(clock, 0.05, lambda t_s: 0.05 * t_s, (0.05, 0.0, 0.0, 0.0, 0.0, 0.0), age_ns)
    found = stopped(arm, clock)
    assert found.speed_m_s == speed_m_s
    assert (found.distance_m is None) == (speed_m_s is None)
    # It may have become faster since its state was measured.
    assert found.declared_s == pytest.approx((0.1 + 1e-9 * age_ns if speed_m_s else 0.2) + STOP_MARGIN_S)


@pytest.mark.parametrize("part", ["place", "twist"])
def test_a_state_with_a_number_missing_tells_nothing(part: str) -> None:
    clock = VirtualClock()
    twist = (0.05, 0.0, 0.0, 0.0, 0.0, math.nan if part == "twist" else 0.0)
    arm = Scripted(clock, 0.05, lambda t_s: math.nan if part == "place" else 0.0, twist)
    found = stopped(arm, clock)
    assert (found.speed_m_s, found.distance_m) == (None, None)
    assert found.kept


def test_the_distance_is_the_farthest_and_not_the_last() -> None:
    clock = VirtualClock()
    found = stopped(Scripted(clock, 0.2, lambda t_s: 0.004 * math.sin(math.pi * t_s / 0.2)), clock)
    assert found.distance_m == pytest.approx(0.004)


def test_nonsense_on_the_way_is_not_measured() -> None:
    clock = VirtualClock()
    found = stopped(Scripted(clock, 0.1, lambda t_s: math.nan if 0.03 < t_s < 0.06 else 0.01 * t_s), clock)
    assert found.distance_m == pytest.approx(0.001)
    assert found.problem == ""


def test_an_arm_first_seen_after_it_was_told_is_watched_without_a_distance() -> None:
    clock = VirtualClock()
    found = stopped(Scripted(clock, 0.1, silent=lambda t_s: t_s < 0.015), clock)
    assert (found.speed_m_s, found.distance_m, found.problem) == (None, None, "")
    assert found.time_s == pytest.approx(0.1)
    assert not found.escalated


def test_it_is_stopped_by_stronger_means_at_its_deadline_and_given_up_after_the_same_time_again() -> None:
    clock = VirtualClock()
    arm = Scripted(clock)
    found = stopped(arm, clock)
    assert arm.stops == [(0, HOLD), (MARGIN_NS, min(StopCategory))]
    assert clock.now_ns() == 2 * MARGIN_NS
    assert "emergency stop" in found.problem


def test_each_arm_is_read_once_per_period_until_it_stands_and_nothing_waits_after_the_last() -> None:
    clock = VirtualClock()
    arms = {"left": Scripted(clock, 0.02), "right": Scripted(clock, 0.05)}
    machine = stopper(arms, clock)
    machine.stop(tripped=True)
    reports = watched(machine)
    assert arms["left"].read_ns[1:] == [k * PERIOD_NS for k in range(3)]
    assert arms["right"].read_ns[1:] == [k * PERIOD_NS for k in range(6)]
    assert clock.now_ns() == 5 * PERIOD_NS
    assert [reports[role].time_s for role in arms] == pytest.approx([0.02, 0.05])


def test_an_arm_given_up_does_not_keep_the_other_from_being_watched() -> None:
    clock = VirtualClock()
    arms = {"gone": Scripted(clock), "slow": Scripted(clock, 0.25, twist=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))}
    machine = stopper(arms, clock)
    machine.stop(tripped=True)
    reports = watched(machine)
    assert reports["gone"].time_s is None
    assert reports["slow"].kept
    assert clock.now_ns() == 250_000_000
    assert arms["slow"].read_ns[1:] == [k * PERIOD_NS for k in range(26)]


def test_a_second_stop_on_the_way_to_rest_is_measured_from_the_first() -> None:
    clock = VirtualClock()
    arm = Scripted(clock, 0.1)
    machine = stopper({"arm": arm}, clock)
    machine.stop(tripped=True)
    clock.advance_s(0.04)
    machine.stop(tripped=True)
    assert watched(machine)["arm"].time_s == pytest.approx(0.1)


def test_a_stop_after_rest_is_measured_anew() -> None:
    clock = VirtualClock()
    arm = Scripted(clock, 0.1)
    machine = stopper({"arm": arm}, clock)
    machine.stop(tripped=True)
    watched(machine)
    assert watched(machine) == {}
    clock.advance_s(1.0)
    machine.stop(tripped=True)
    assert watched(machine)["arm"].time_s == pytest.approx(0.0)


LIMITS = Scripted.limits


def told_late(
    linear: float, angular: float, age_s: float, period_s: float, gain: float, reacts_s: float, brakes: float
) -> tuple[StopReport, float]:
    """An arm that is measured ``age_s`` before the stop, becomes faster until it, and then brakes.

    ``gain`` and ``brakes`` are shares of the acceleration limits. Returns the report, and when it really stood.
    """
    clock = VirtualClock(10**12)
    start_s = 1e-9 * clock.now_ns()
    v = max(linear, min(linear + gain * LIMITS.accel_m_s2 * age_s, LIMITS.speed_m_s))
    w = max(angular, min(angular + gain * LIMITS.rot_accel_rad_s2 * age_s, LIMITS.rot_speed_rad_s))
    decel = brakes * LIMITS.accel_m_s2
    rest_s = reacts_s + max(v / decel, w / (brakes * LIMITS.rot_accel_rad_s2))

    def x_m(t_s: float) -> float:
        since_s = t_s - start_s
        braking_s = min(max(since_s - reacts_s, 0.0), v / decel)
        # Where it is now; a state is always ``age_s`` old, which what is measured of the way does not gain from.
        return v * min(max(since_s, 0.0), reacts_s) + v * braking_s - 0.5 * decel * braking_s**2

    class Late(Scripted):
        def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
            state = super().tcp(max_age_s)
            if not self.stops or len(self.read_ns) == 1:
                # The farthest it can have come between its state and the stop.
                state.value.T_base_tcp[0, 3] = -0.5 * (linear + v) * age_s
            return state

    arm = Late(clock, start_s + rest_s, x_m, (linear, 0, 0, 0, 0, angular), round(1e9 * age_s))
    machine = Stopper({"arm": arm}, {"arm": HOLD}, clock, period_s)
    machine.stop(tripped=True)
    return watched(machine)["arm"], rest_s


def test_positions_of_an_arm_that_stands_may_be_a_tenth_of_a_millimetre_apart() -> None:
    for noise_m, kept in ((0.99e-4, True), (1.01e-4, False)):
        clock = VirtualClock()
        found = stopped(Scripted(clock, 0.015, lambda t_s, noise_m=noise_m: noise_m if t_s > 0.005 else 0.0), clock)
        assert found.distance_m == noise_m
        assert found.kept == kept


@given(
    linear=st.floats(0.0, LIMITS.speed_m_s),
    angular=st.floats(0.0, LIMITS.rot_speed_rad_s),
    period_s=st.sampled_from([0.001, 0.01, 0.05]),
    age=st.floats(0.0, 2.0),
    gain=st.floats(0.0, 1.0),
    reacts=st.floats(0.0, 1.0),
    brakes=st.floats(1.0, 3.0),
)
def test_a_stop_within_the_limits_is_kept_however_old_its_state_was(
    linear: float, angular: float, period_s: float, age: float, gain: float, reacts: float, brakes: float
) -> None:
    # Rest is noticed in the first period after it.
    reacts_s = reacts * (STOP_MARGIN_S - period_s - 1e-6)
    found, rest_s = told_late(linear, angular, age * period_s, period_s, gain, reacts_s, brakes)
    assert found.kept
    assert not found.escalated
    assert found.time_s is not None
    assert found.time_s >= rest_s - 1e-6, "nothing is called a stop that is none yet"


@given(
    linear=st.floats(0.0, LIMITS.speed_m_s),
    angular=st.floats(0.0, LIMITS.rot_speed_rad_s),
    period_s=st.sampled_from([0.001, 0.01, 0.05]),
    age=st.floats(0.0, 2.0),
    brakes=st.floats(0.05, 1.0),
    reacts_s=st.floats(0.0, 0.5),
)
def test_what_is_kept_took_no_longer_and_no_further_than_the_limits_and_the_age_of_its_state_allow(
    linear: float, angular: float, period_s: float, age: float, brakes: float, reacts_s: float
) -> None:
    age_s = age * period_s
    found, rest_s = told_late(linear, angular, age_s, period_s, 1.0, reacts_s, brakes)
    slack_s = age_s + STOP_MARGIN_S
    most_s = max(linear / LIMITS.accel_m_s2, angular / LIMITS.rot_accel_rad_s2) + slack_s
    most_m = LIMITS.speed_m_s * (0.5 * (linear / LIMITS.accel_m_s2 + age_s) + slack_s)
    if found.kept:
        assert rest_s <= most_s + 1e-6
        assert found.distance_m is not None
        assert found.distance_m <= most_m + 1e-6
    if rest_s > most_s + 1e-6:
        assert not found.kept
    if rest_s > most_s + period_s:
        assert found.escalated
