"""Interlocks with state: what starts, keeps and clears it, and what lasts too long."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch, ResetDone
from touchcell.control.supervisor import LIMIT_FOR_NS, REDUCED, Supervisor
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import OperatorToken
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry import se3

CYCLE_NS = 10_000_000
SENSOR = SensorView(0, 0, True, 0.003)


def rule(**settings: Any) -> TimedInterlock:
    (built,) = build_interlocks(parse_interlocks({"it": settings}), {})
    assert isinstance(built, TimedInterlock)
    return built


def sensor_cycle(k: int, *, task_state: str = "run", **changes: Any) -> CellView:
    seen = replace(SENSOR, t_frame_ns=k * CYCLE_NS, seq=k, **changes)
    return CellView(k * CYCLE_NS, {}, {"sensor": seen}, task_state)


def arm_cycle(
    k: int, *, x_mm: float = 0.0, vx_mm_s: float = 0.0, sent_mm_s: float | None = None, held: bool = False
) -> CellView:
    T = se3.from_euler_mm_deg(np.array([x_mm, 0, 0, 0, 0, 0.0]))
    state = Stamped(TcpState(T, np.array([1e-3 * vx_mm_s, 0, 0, 0, 0, 0])), k * CYCLE_NS, k)
    sent = None
    if sent_mm_s is not None:
        command = TwistCommand(np.array([1e-3 * sent_mm_s, 0, 0, 0, 0, 0]), TwistFrame.BASE, k * CYCLE_NS, 0.03)
        sent = Sent(command, k * CYCLE_NS, (Adjustment("tcp linear speed", 0.2, 0.1),) if held else ())
    return CellView(k * CYCLE_NS, {"arm": ArmView(state, sent=sent)})


def evaluate(interlock: TimedInterlock, views: list[CellView]) -> list[Violation | None]:
    past: Any = {}
    found = []
    for view in views:
        violation, past = interlock.evaluate(view, past)
        found.append(violation)
    return found


def first(found: list[Violation | None]) -> int:
    """Cycle of the first violation."""
    return next(k for k, violation in enumerate(found) if violation is not None)


def test_a_frozen_image_is_detected_although_frames_keep_arriving() -> None:
    interlock = rule(kind="frame_frozen", limit_ms=50)
    live = [sensor_cycle(k, content=k) for k in range(5)]
    found = evaluate(interlock, live + [sensor_cycle(k, content=4) for k in range(5, 12)])
    # Content 4 was first seen in cycle 4; more than 50 ms later is cycle 10.
    assert first(found) == 10
    violation = found[10]
    assert violation is not None
    assert (violation.subject, violation.severity, violation.frame_seq) == ("sensor", Severity.TRIP, 10)
    assert violation.value == pytest.approx(0.06)


def test_without_content_the_frame_number_has_to_change() -> None:
    interlock = rule(kind="frame_frozen", limit_ms=50)
    stuck = [replace(sensor_cycle(k), sensors={"sensor": replace(SENSOR, seq=7)}) for k in range(8)]
    assert first(evaluate(interlock, stuck)) == 6
    assert evaluate(interlock, [sensor_cycle(k) for k in range(20)]) == [None] * 20


def test_exposure_is_compared_with_the_first_ten_frames() -> None:
    interlock = rule(kind="exposure", limit_percent=20)
    cycles = [sensor_cycle(k, brightness=50.0 + (k % 2)) for k in range(10)]
    cycles += [sensor_cycle(10, brightness=60.5), sensor_cycle(11, brightness=60.7), sensor_cycle(12, brightness=40.3)]
    found = evaluate(interlock, cycles)
    assert found[:11] == [None] * 11
    assert found[11] is not None
    assert found[11].value == pytest.approx(100 * (60.7 / 50.5 - 1))
    assert found[12] is not None


def test_a_lost_contact_trips_only_after_it_was_made_and_while_it_is_wanted() -> None:
    interlock = rule(kind="contact_lost", limit_ms=30)

    def cycle(k: int, contact: bool, state: str) -> CellView:
        return sensor_cycle(k, in_contact=contact, task_state=state)

    assert evaluate(interlock, [cycle(k, False, "approach") for k in range(20)]) == [None] * 20
    lost = [cycle(0, True, "run"), cycle(1, False, "run"), *(cycle(k, False, "approach") for k in range(2, 6))]
    assert first(evaluate(interlock, lost)) == 4
    regained = [cycle(0, True, "run"), cycle(1, False, "run"), cycle(2, True, "run"), cycle(5, False, "run")]
    assert evaluate(interlock, regained) == [None] * 4
    withdrawn = [cycle(0, True, "run"), *(cycle(k, False, "retract") for k in range(1, 20)), cycle(20, False, "run")]
    assert evaluate(interlock, withdrawn) == [None] * 21


@pytest.mark.parametrize(
    ("settings", "name", "per_unit"),
    [
        ({"kind": "uncertain", "limit_mm": 1.0, "hold_ms": 30}, "sigma_depth_m", 1e-3),
        ({"kind": "shear", "limit_mm": 1.0, "hold_ms": 30}, "shear_m", 1e-3),
        ({"kind": "torsion", "limit_deg": 1.0, "hold_ms": 30}, "torsion_rad", -np.pi / 180),
    ],
)
def test_values_count_from_the_limit_down_to_the_leave_limit(
    settings: dict[str, Any], name: str, per_unit: float
) -> None:
    interlock = rule(**settings)

    def run(values: list[float]) -> list[Violation | None]:
        return evaluate(interlock, [sensor_cycle(k, **{name: per_unit * value}) for k, value in enumerate(values)])

    assert run([0.99] * 20) == [None] * 20
    # 0.9 lies between the leave limit of 0.8 and the limit: it keeps what 1.1 began.
    held = run([1.1, 0.9, 0.9, 0.9])
    assert first(held) == 3
    assert held[3] is not None
    assert (held[3].value, held[3].limit) == (pytest.approx(0.9), 1.0)
    assert run([1.1, 0.79, 1.1, 0.9, 0.9]) == [None] * 5


def test_innovations_are_counted_by_frame_not_by_cycle() -> None:
    interlock = rule(kind="inconsistent", limit_nis=20, frames=3)
    views = [replace(sensor_cycle(k), sensors={"sensor": replace(SENSOR, seq=k // 4, nis=25.0)}) for k in range(12)]
    found = evaluate(interlock, views)
    assert first(found) == 8
    assert evaluate(interlock, [sensor_cycle(k, nis=25.0 if k % 3 else 1.0) for k in range(30)]) == [None] * 30


def test_out_of_range_is_tolerated_for_a_while() -> None:
    interlock = rule(kind="out_of_range", limit_ms=50)
    assert first(evaluate(interlock, [sensor_cycle(k, in_range=False) for k in range(10)])) == 6
    assert evaluate(interlock, [sensor_cycle(k, in_range=k % 5 == 0) for k in range(40)]) == [None] * 40


def test_a_frame_that_was_refused_trips_with_its_reason() -> None:
    interlock = rule(kind="out_of_range", limit_ms=50)
    cycles = [sensor_cycle(k, in_range=False, refusal="the markers do not move as those of one tip") for k in range(10)]
    violation = next(filter(None, evaluate(interlock, cycles)))
    assert "the markers do not move as those of one tip" in str(violation)


def test_tracking_error_is_measured_against_the_sent_command() -> None:
    interlock = rule(kind="tracking", limit_mm_s=5, hold_ms=30)
    good = evaluate(interlock, [arm_cycle(k, vx_mm_s=20, sent_mm_s=24) for k in range(20)])
    assert good == [None] * 20
    bad = evaluate(interlock, [arm_cycle(k, vx_mm_s=0, sent_mm_s=20) for k in range(20)])
    assert first(bad) == 3
    assert bad[3] is not None
    assert bad[3].value == pytest.approx(20.0)


def test_a_stopped_arm_may_settle_and_then_must_not_drift() -> None:
    interlock = rule(kind="standstill", limit_mm=1, settle_ms=50)
    settling = [arm_cycle(k, x_mm=5.0 * min(k, 5)) for k in range(30)]
    assert evaluate(interlock, settling) == [None] * 30
    drifting = [arm_cycle(k, x_mm=0.1 * k) for k in range(30)]
    found = evaluate(interlock, drifting)
    # Anchored in cycle 5, at 0.5 mm; beyond 1.5 mm from cycle 16.
    assert first(found) == 16
    assert evaluate(interlock, [arm_cycle(k, x_mm=k, sent_mm_s=100) for k in range(30)]) == [None] * 30


def test_a_gate_that_limits_for_long_trips() -> None:
    interlock = rule(kind="limited", limit_ms=300)
    found = evaluate(interlock, [arm_cycle(k, sent_mm_s=100, held=True) for k in range(40)])
    assert first(found) == 31
    assert found[31] is not None
    assert "tcp linear speed" in found[31].reason
    assert evaluate(interlock, [arm_cycle(k, sent_mm_s=100, held=k % 30 != 0) for k in range(90)]) == [None] * 90


def test_a_limit_slows_down_and_trips_when_it_lasts() -> None:
    settings = {"it": {"kind": "shear", "limit_mm": 1.0, "severity": "limit"}}
    supervisor = Supervisor(build_interlocks(parse_interlocks(settings), {}), Latch())
    calm = supervisor.review(sensor_cycle(0, shear_m=0.5e-3))
    assert (calm.allow, calm.speed) == (True, 1.0)
    verdicts = [supervisor.review(sensor_cycle(k, shear_m=2e-3)) for k in range(1, 40)]
    allowed = sum(verdict.allow for verdict in verdicts)
    assert allowed == LIMIT_FOR_NS // CYCLE_NS + 1
    assert {verdict.speed for verdict in verdicts} == {REDUCED}
    trip = verdicts[-1].trip
    assert trip is not None
    assert "limiting for over 300 ms" in trip.reason


def limiting(kind: str = "shear", **settings: Any) -> Supervisor:
    section = {"it": {"kind": kind, "limit_mm": 1.0, "severity": "limit", **settings}}
    return Supervisor(build_interlocks(parse_interlocks(section), {}), Latch())


def first_refused(supervisor: Supervisor, views: list[CellView]) -> int | None:
    return next((k for k, view in enumerate(views) if not supervisor.review(view).allow), None)


def test_a_limit_that_flickers_trips_almost_as_soon_as_one_that_stays() -> None:
    views = [sensor_cycle(k, shear_m=0.0 if k % 29 == 28 else 2e-3) for k in range(100)]
    assert first_refused(limiting(), views) == LIMIT_FOR_NS // CYCLE_NS + 2, "one cycle lost"


def test_a_limit_that_is_there_half_of_the_time_trips_and_one_in_ten_never_does() -> None:
    half = [sensor_cycle(k, shear_m=2e-3 * (k % 2)) for k in range(200)]
    at = first_refused(limiting(), half)
    assert at is not None
    assert at * CYCLE_NS == pytest.approx(LIMIT_FOR_NS / 0.375, rel=0.05)
    seldom = [sensor_cycle(k, shear_m=2e-3 * (k % 10 == 0)) for k in range(2000)]
    assert first_refused(limiting(), seldom) is None


@pytest.mark.parametrize("every", [1, 2, 7])
def test_a_limit_trips_whichever_of_two_sensors_is_the_worse(every: int) -> None:
    """Both are too deep all the time; which one is reported alternates."""
    supervisor = limiting("depth")
    views = []
    for k in range(60):
        deeper = (k // every) % 2
        depths = {"left": 1.5e-3 + 1e-4 * deeper, "right": 1.5e-3 + 1e-4 * (1 - deeper)}
        sensors = {role: replace(SENSOR, t_frame_ns=k * CYCLE_NS, seq=k, depth_m=d) for role, d in depths.items()}
        views.append(CellView(k * CYCLE_NS, {}, sensors, "run"))
    assert first_refused(supervisor, views) == LIMIT_FOR_NS // CYCLE_NS + 1


def test_time_of_one_rule_is_not_counted_for_another() -> None:
    section = {
        "shear": {"kind": "shear", "limit_mm": 1.0, "severity": "limit"},
        "depth": {"kind": "depth", "limit_mm": 4.0, "severity": "limit"},
    }
    supervisor = Supervisor(build_interlocks(parse_interlocks(section), {}), Latch())
    one = [sensor_cycle(k, shear_m=2e-3, depth_m=3e-3) for k in range(25)]
    other = [sensor_cycle(k, shear_m=0.0, depth_m=5e-3) for k in range(25, 55)]
    assert first_refused(supervisor, one + other) is None


def test_a_reset_forgets_for_how_long_a_rule_has_limited() -> None:
    supervisor = limiting()
    views = [sensor_cycle(k, shear_m=2e-3) for k in range(40)]
    assert first_refused(supervisor, views) is not None
    calm = sensor_cycle(40, shear_m=0.0)
    supervisor.review(calm)
    assert isinstance(supervisor.reset(OperatorToken("ada", calm.now_ns + 1), calm), ResetDone)
    again = [sensor_cycle(k, shear_m=2e-3) for k in range(41, 41 + LIMIT_FOR_NS // CYCLE_NS)]
    assert first_refused(supervisor, again) is None


@given(st.lists(st.booleans(), min_size=1, max_size=150))
def test_a_limit_never_trips_before_its_time_and_always_once_it_outweighs_the_pauses(above: list[bool]) -> None:
    supervisor = limiting()
    total = 0.0
    tripped = False
    for k, now in enumerate(above):
        if k:
            total = max(0.0, total + (1.0 if above[k - 1] else -0.25))
        allowed = supervisor.review(sensor_cycle(k, shear_m=2e-3 if now else 0.0)).allow
        tripped = tripped or (now and total > LIMIT_FOR_NS / CYCLE_NS)
        assert allowed == (not tripped)


@given(
    values=st.lists(st.floats(0, 2e-3), min_size=1, max_size=40),
    limit=st.floats(0.1, 1.5),
    share=st.floats(0.1, 1.0),
)
def test_a_sustained_rule_is_pure_and_never_fires_below_its_leave_limit(
    values: list[float], limit: float, share: float
) -> None:
    interlock = rule(kind="shear", limit_mm=limit, leave_mm=share * limit, hold_ms=20)
    views = [sensor_cycle(k, shear_m=value) for k, value in enumerate(values)]
    found = evaluate(interlock, views)
    assert found == evaluate(interlock, views)
    for value, violation in zip(values, found, strict=True):
        if violation is not None:
            assert 1e3 * value > share * limit
    if max(values) * 1e3 <= limit:
        assert not any(found)
