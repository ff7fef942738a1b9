"""Rules that need no key: every role is in the view, and the loop does not hang unseen."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.helpers.pushing_cell import cell_file
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.pacing import Pacing
from touchcell.cell.runtime.run_result import Outcome, Progress
from touchcell.control.interlocks.always_on import Missing, Overrun, default_overrun_s
from touchcell.control.interlocks.config import parse_interlocks
from touchcell.control.interlocks.snapshot import CellView, SensorView
from touchcell.control.interlocks.timers import InterlockState
from touchcell.control.interlocks.violation import Severity
from touchcell.drivers.core.clock import VirtualClock


def view(now_s: float, *, at_work: bool = True, sensors: tuple[str, ...] = ()) -> CellView:
    now_ns = round(1e9 * now_s)
    return CellView(now_ns, {}, {role: SensorView(now_ns, 0, False) for role in sensors}, at_work=at_work)


@pytest.mark.parametrize(("gap_s", "trips"), [(0.01, False), (0.1, False), (0.1001, True), (0.5, True), (10.0, True)])
def test_a_gap_beyond_the_limit_is_an_overrun(gap_s: float, trips: bool) -> None:
    rule = Overrun("overrun", Severity.TRIP, 0.1)
    first, past = rule.evaluate(view(1.0), {})
    assert first is None
    found, _ = rule.evaluate(view(1.0 + gap_s), past)
    assert (found is not None) == trips
    if found is not None:
        assert found.value == pytest.approx(gap_s)
        assert found.limit == 0.1


def test_time_spent_waiting_for_a_reset_is_no_overrun() -> None:
    rule = Overrun("overrun", Severity.TRIP, 0.1)
    past: InterlockState = {}
    for now_s, at_work in ((0.0, True), (5.0, False), (9.0, False), (20.0, True), (20.01, True)):
        found, past = rule.evaluate(view(now_s, at_work=at_work), past)
        assert found is None


@pytest.mark.parametrize(
    ("rate_hz", "ages_ms", "limit_s"),
    [
        (100.0, {"arm_state_age": 100, "frame_age": 300}, 0.1),
        (100.0, {"arm_state_age": 500, "frame_age": 80}, 0.08),
        (100.0, {"arm_state_age": 1e9, "frame_age": 1e9}, 0.3),
        (100.0, {}, 0.3),
        (10.0, {"arm_state_age": 100}, 0.25),
        (500.0, {"arm_state_age": 2}, 0.005),
    ],
)
def test_the_limit_follows_from_rate_and_ages(rate_hz: float, ages_ms: dict[str, float], limit_s: float) -> None:
    settings = parse_interlocks({kind: {"kind": kind, "limit_ms": ms} for kind, ms in ages_ms.items()})
    assert default_overrun_s(rate_hz, settings.values()) == pytest.approx(limit_s)


def test_a_missing_arm_is_a_fault_at_once_and_a_sensor_has_a_second_for_its_first_frame() -> None:
    rule = Missing("missing", Severity.FAULT, frozenset({"arm"}), frozenset())
    found, _ = rule.evaluate(view(0.0), {})
    assert found is not None
    assert (found.severity, found.subject) == (Severity.FAULT, "arm")
    rule = Missing("missing", Severity.FAULT, frozenset(), frozenset({"sensor"}))
    past: InterlockState = {}
    for now_s in (0.0, 0.5, 1.0):
        found, past = rule.evaluate(view(now_s), past)
        assert found is None
    found, _ = rule.evaluate(view(1.01), past)
    assert found is not None
    assert found.subject == "sensor"


def test_a_sensor_that_vanishes_is_a_fault_at_once() -> None:
    rule = Missing("missing", Severity.FAULT, frozenset(), frozenset({"sensor"}))
    found, past = rule.evaluate(view(0.0, sensors=("sensor",)), {})
    assert found is None
    found, past = rule.evaluate(view(0.01), past)
    assert found is not None
    found, _ = rule.evaluate(view(0.02, sensors=("sensor",)), past)
    assert found is None


@pytest.mark.parametrize(("pause_s", "outcome"), [(0.5, Outcome.TRIPPED), (0.02, Outcome.DONE)])
@pytest.mark.parametrize("own_limit", [False, True])
def test_a_loop_that_hung_does_not_go_on(tmp_path: Path, pause_s: float, outcome: Outcome, own_limit: bool) -> None:
    data = cell_file("surface_follow_sim.yaml", task__distance_mm=4)
    if own_limit:
        data["interlocks"]["late"] = {"kind": "overrun", "limit_ms": 50}
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    cell = compose(plan_cell(path))
    hung = []

    def hang(progress: Progress) -> None:
        if progress.state == "run" and not hung:
            hung.append(progress)
            cell.clock.sleep_until_ns(cell.clock.now_ns() + round(1e9 * pause_s))

    with cell:
        result = RunLoop(cell, None, on_cycle=hang).run()
    assert hung
    assert result.outcome is outcome
    if outcome is Outcome.TRIPPED:
        assert result.causes[0].interlock == ("late" if own_limit else "overrun")


def test_missed_cycles_are_not_made_up_for() -> None:
    clock = VirtualClock()
    pacing = Pacing(clock, 100.0)
    pacing.wait()
    assert clock.now_ns() == 10_000_000
    clock.advance_s(0.5)
    times = []
    for _ in range(3):
        pacing.wait()
        times.append(clock.now_ns())
    assert times == [510_000_000, 520_000_000, 530_000_000]
