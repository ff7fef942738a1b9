"""The supervisor: order of the checks, the latch behind them, and the effects of a reset."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.basic import Depth, TcpSpeed
from touchcell.control.interlocks.errors import SafetyTrip
from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import OnDelay, Reading, Sustained
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch, LatchState, Refusal, ResetDone, ResetRefused
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import OperatorToken
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import TouchcellError

DEPTH = Depth("depth", Severity.TRIP, 0.006)
SPEED = TcpSpeed("speed", Severity.TRIP, 0.1, 1.0)
MOVE = np.array([0.01, 0, 0, 0, 0, 0])


def view(now_ns=100, depth_m=0.003, measured=None, command=None) -> CellView:
    twist = np.zeros(6) if measured is None else measured
    wanted = None if command is None else TwistCommand(command, TwistFrame.TCP, now_ns, 0.03)
    return CellView(
        now_ns,
        {"arm": ArmView(Stamped(TcpState(np.eye(4), twist), now_ns, 1), wanted)},
        {"sensor": SensorView(now_ns, 42, True, depth_m)},
    )


@dataclass(frozen=True)
class Broken:
    """An interlock with a bug."""

    name: str = "broken"
    severity: Severity = Severity.TRIP

    def check(self, view: CellView) -> Violation | None:
        return view.arms["no such arm"]  # type: ignore[return-value]


@dataclass(frozen=True)
class Warned:
    """An interlock that only limits."""

    name: str = "warned"
    severity: Severity = Severity.LIMIT

    def check(self, view: CellView) -> Violation | None:
        return Violation(self.name, self.severity, "arm", "slow down", view.now_ns)


def test_allows_motion_without_violations():
    verdict = Supervisor([DEPTH, SPEED], Latch()).review(view(command=MOVE))
    assert verdict.allow
    assert verdict.violations == ()
    assert verdict.trip is None


def test_a_violation_stops_and_stays():
    supervisor = Supervisor([DEPTH, SPEED], Latch())
    verdict = supervisor.review(view(now_ns=100, depth_m=0.0065, command=MOVE))
    assert not verdict.allow
    assert isinstance(verdict.trip, SafetyTrip)
    assert isinstance(verdict.trip, TouchcellError)
    trip = verdict.trip
    assert (trip.interlock, trip.subject, trip.value, trip.limit) == ("depth", "sensor", 0.0065, 0.006)
    assert (trip.unit, trip.t_ns, trip.frame_seq) == ("m", 100, 42)
    later = supervisor.review(view(now_ns=200, command=MOVE))
    assert not later.allow
    assert later.violations == ()
    assert later.trip.t_ns == 100


def test_finite_is_checked_first_and_alone():
    verdict = Supervisor([Broken(), DEPTH], Latch()).review(view(depth_m=0.01, command=np.full(6, np.nan)))
    assert [v.interlock for v in verdict.violations] == ["finite"]
    assert not verdict.allow


def test_finite_is_always_on():
    assert not Supervisor([], Latch()).review(view(depth_m=float("nan"))).allow


def test_an_interlock_that_raises_is_a_fault():
    latch = Latch()
    verdict = Supervisor([Broken()], latch).review(view())
    assert not verdict.allow
    assert latch.state is LatchState.FAULTED
    assert "no such arm" in verdict.trip.reason


def test_a_limit_is_reported_and_motion_continues():
    verdict = Supervisor([Warned()], Latch()).review(view(command=MOVE))
    assert verdict.allow
    assert [v.interlock for v in verdict.violations] == ["warned"]


def test_all_violations_of_a_cycle_are_listed():
    fast = np.array([0.2, 0, 0, 0, 0, 0])
    verdict = Supervisor([DEPTH, SPEED], Latch()).review(view(depth_m=0.01, command=fast))
    assert [v.interlock for v in verdict.violations] == ["depth", "speed"]


@pytest.mark.parametrize(
    ("now", "reason"),
    [
        ({"depth_m": 0.007}, Refusal.CAUSE_PRESENT),
        ({"measured": 0.5 * MOVE}, Refusal.NOT_AT_REST),
        ({"measured": np.array([0, 0, 0, 0, 0, 0.02])}, Refusal.NOT_AT_REST),
        ({"command": MOVE}, Refusal.MOTION_COMMANDED),
    ],
)
def test_reset_is_judged_on_the_present_view(now, reason):
    supervisor = Supervisor([DEPTH, SPEED], Latch())
    supervisor.review(view(depth_m=0.007))
    assert supervisor.reset(OperatorToken("ada", 500), view(now_ns=400, **now)) == ResetRefused(reason)
    assert not supervisor.review(view(now_ns=600)).allow


def test_reset_clears():
    supervisor = Supervisor([DEPTH], Latch())
    supervisor.review(view(depth_m=0.007))
    assert isinstance(supervisor.reset(OperatorToken("ada", 500), view(now_ns=400)), ResetDone)
    verdict = supervisor.review(view(now_ns=600))
    assert verdict.allow
    assert verdict.trip is None


@given(st.lists(st.tuples(st.floats(0, 0.012), st.booleans()), max_size=30))
def test_nothing_is_allowed_between_a_trip_and_a_reset(cycles):
    supervisor = Supervisor([DEPTH], Latch())
    latched = False
    for k, (depth_m, ask_reset) in enumerate(cycles):
        now_ns = 10 * k
        if ask_reset:
            latched = not isinstance(
                supervisor.reset(OperatorToken("ada", now_ns), view(now_ns, depth_m)), ResetDone
            ) and (latched or depth_m > 0.006)
        verdict = supervisor.review(view(now_ns, depth_m, command=MOVE))
        latched = latched or depth_m > 0.006
        assert verdict.allow == (not latched)
        assert (verdict.trip is None) == (not latched)


@dataclass
class Limits:
    """An interlock that limits whenever ``on``, and trips after that or not as ``escalates`` is."""

    on: bool = True
    escalates: bool = True
    name: str = "limits"
    severity: Severity = Severity.LIMIT

    def check(self, view: CellView) -> Violation | None:
        found = Violation(self.name, self.severity, "arm", "slow down", view.now_ns, escalates=self.escalates)
        return found if self.on else None


def cycles(supervisor: Supervisor, start_ns: int, duration_ms: int) -> tuple[Severity, ...]:
    """Review every 10 ms; return the severities of the last cycle."""
    verdict = None
    for k in range(duration_ms // 10 + 1):
        verdict = supervisor.review(view(now_ns=start_ns + k * 10_000_000))
    assert verdict is not None
    return tuple(v.severity for v in verdict.violations)


def test_a_limit_scales_the_speed_to_a_quarter():
    supervisor = Supervisor([Warned()], Latch())
    assert supervisor.review(view()).speed == 0.25
    assert Supervisor([], Latch()).review(view()).speed == 1.0


def test_a_refused_reset_does_not_forget_how_long_a_limit_has_lasted():
    supervisor = Supervisor([Limits()], Latch())
    cycles(supervisor, 0, 200)
    refused = supervisor.reset(OperatorToken("ada", 210_000_000), view(now_ns=210_000_000))
    assert refused == ResetRefused(Refusal.NOT_LATCHED)
    assert cycles(supervisor, 220_000_000, 100) == (Severity.TRIP,)


def test_time_that_does_not_count_is_not_held_against_a_later_limit_of_the_same_interlock():
    rule = Limits(escalates=False)
    supervisor = Supervisor([rule], Latch())
    assert cycles(supervisor, 0, 1000) == (Severity.LIMIT,)
    rule.escalates = True
    assert cycles(supervisor, 1_010_000_000, 200) == (Severity.LIMIT,)
    assert cycles(supervisor, 1_220_000_000, 200) == (Severity.TRIP,)


def test_a_limit_that_lasted_long_is_forgotten_within_four_times_twice_its_time():
    rule = Limits()
    supervisor = Supervisor([rule], Latch())
    cycles(supervisor, 0, 10_000)
    rule.on = False
    cycles(supervisor, 10_010_000_000, 1_600)
    rule.on = True
    assert cycles(supervisor, 11_620_000_000, 50) == (Severity.LIMIT,)


@pytest.mark.parametrize(
    ("measured", "at_rest"),
    [
        ((1e-3, 0, 0, 0, 0, 0), True),
        ((1.1e-3, 0, 0, 0, 0, 0), False),
        ((0, 0, 0, 0, 0, 1e-2), True),
        ((0, 0, 0, 0, 0, 1.1e-2), False),
        ((1e-3, 0, 0, 0, 1e-2, 0), True),
    ],
)
def test_an_arm_is_at_rest_up_to_a_millimetre_and_a_hundredth_of_a_radian_per_second(measured, at_rest):
    supervisor = Supervisor([DEPTH], Latch())
    supervisor.review(view(depth_m=0.007))
    outcome = supervisor.reset(OperatorToken("ada", 500), view(now_ns=400, measured=np.array(measured, float)))
    assert isinstance(outcome, ResetDone) == at_rest


@pytest.mark.parametrize(("creep_mm_s", "at_rest"), [(0.0, True), (0.5, True), (3.0, False)])
def test_an_arm_whose_speeds_are_noisy_is_at_rest_when_its_positions_are(creep_mm_s: float, at_rest: bool) -> None:
    supervisor = Supervisor([DEPTH], Latch())
    noise = np.array([0.006, 0, 0, 0, 0.02, 0])

    def seen(now_ns: int, depth_m: float = 0.003) -> CellView:
        one = view(now_ns=now_ns, depth_m=depth_m, measured=noise if now_ns // 20_000_000 % 2 else -noise)
        T = np.eye(4)
        T[0, 3] = 1e-12 * creep_mm_s * now_ns
        state = Stamped(TcpState(T, one.arms["arm"].state.value.twist), now_ns, 1)
        return CellView(now_ns, {"arm": ArmView(state)}, one.sensors)

    supervisor.review(seen(0, depth_m=0.0065))
    assert isinstance(supervisor.reset(OperatorToken("op", 1), seen(20_000_000)), ResetRefused)
    for number in range(2, 40):
        supervisor.review(seen(number * 20_000_000))
    outcome = supervisor.reset(OperatorToken("op", 40 * 20_000_000), seen(40 * 20_000_000))
    assert isinstance(outcome, ResetDone) is at_rest


def test_it_shows_how_near_each_quantity_is_to_its_limit() -> None:
    tilted = Sustained("shear", Severity.TRIP, lambda now: [Reading("sensor", 4.0)], "sheared by", 6.0, 5.0, "mm", 0.1)
    lasting = OnDelay("limited", Severity.TRIP, lambda now: {"arm": "limited"}, 0.3)
    supervisor = Supervisor([DEPTH, tilted, lasting], Latch())
    assert supervisor.levels() == []
    first = view()
    supervisor.review(first)
    supervisor.review(replace(first, now_ns=first.now_ns + 120_000_000))
    assert supervisor.levels() == [
        ("shear", Level("sensor", 4.0, 6.0, "mm")),
        ("limited", Level("arm", pytest.approx(120.0), 300.0, "ms")),
    ]


def test_what_cannot_be_shown_disturbs_nothing() -> None:
    def broken(now: CellView) -> list[Reading]:
        raise RuntimeError("no such reading")

    rule = Sustained("broken", Severity.TRIP, broken, "", 1.0, 1.0, "")
    supervisor = Supervisor([rule], Latch())
    supervisor.review(view())
    assert supervisor.levels() == []
