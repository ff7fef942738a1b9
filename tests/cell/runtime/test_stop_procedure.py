"""Devices that are no arms stop with the arms, and the run waits until they are at rest."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import yaml

from tests.helpers.pushing_cell import cell_file
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, RunResult
from touchcell.cell.runtime.stop_procedure import DEVICE_REST_S, StopProcedure
from touchcell.cell.runtime.stopping import STOP_MARGIN_S
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import unlogged_latch
from touchcell.drivers.core.clock import Clock, VirtualClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import DeviceFault
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.protocols import StopCategory
from touchcell.drivers.core.samples import Stamped, TcpState


class Turntable(Device):
    """Comes to rest some time after a stop, or never, or cannot be asked."""

    def __init__(self, clock: Clock, rest_s: float, error: Exception | None = None) -> None:
        super().__init__("turntable", clock)
        self._rest_s, self._error = rest_s, error
        self.stopped_ns: int | None = None
        self.asked_ns: list[int] = []

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        self.stopped_ns = self.stopped_ns or self._clock.now_ns()

    def at_rest(self) -> bool:
        self.asked_ns.append(self._clock.now_ns())
        if self._error is not None:
            raise self._error
        return self.stopped_ns is not None and (self.asked_ns[-1] - self.stopped_ns) * 1e-9 >= self._rest_s

    def _open(self) -> None: ...

    def _close(self) -> None: ...


def stopped(tmp_path: Path, rest_s: float, error: Exception | None = None) -> tuple[RunResult, Turntable]:
    """Return the result of a run that is stopped at work, and its turntable."""
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(cell_file("surface_follow_sim.yaml")))
    cell = compose(plan_cell(file))
    table = Turntable(cell.clock, rest_s, error)
    cell.auxiliaries = {"table": table}
    with cell:
        loop = RunLoop(cell, None)
        for _ in range(60):
            assert loop.step()
        return loop.end(), table


def test_a_run_ends_only_when_its_other_devices_are_at_rest(tmp_path: Path) -> None:
    result, table = stopped(tmp_path, rest_s=1.5)
    assert result.outcome is Outcome.STOPPED
    assert table.stopped_ns is not None
    assert (table.asked_ns[-1] - table.stopped_ns) * 1e-9 == pytest.approx(1.5, abs=0.0101)


@pytest.mark.parametrize("error", [None, DeviceFault("turntable", "blind"), ValueError("a value")])
def test_a_device_that_is_not_seen_at_rest_in_time_is_a_fault_and_the_run_ends(
    tmp_path: Path, error: Exception | None
) -> None:
    result, table = stopped(tmp_path, rest_s=1e9, error=error)
    assert result.outcome is Outcome.TRIPPED
    assert [(v.interlock, v.subject) for v in result.causes] == [("stop", "table")]
    assert table.stopped_ns is not None
    assert (table.asked_ns[-1] - table.stopped_ns) * 1e-9 == pytest.approx(DEVICE_REST_S, abs=0.0101)


class Arm:
    """Comes to rest some time after a stop of a category; a stop may raise."""

    name = "arm"
    stop_categories = frozenset(StopCategory)
    limits = TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0)

    def __init__(self, clock: Clock, rest_s: Callable[[StopCategory], float], error: Exception | None = None) -> None:
        self._clock, self._rest_s, self._error = clock, rest_s, error
        self.stops: list[StopCategory] = []
        self._rest_ns = 10**18

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        return Stamped(TcpState(np.eye(4), np.zeros(6)), self._clock.now_ns(), 1)

    def stop(self, category: StopCategory) -> None:
        self.stops.append(category)
        self._rest_ns = self._clock.now_ns() + round(1e9 * min(self._rest_s(category), 1e6))
        if self._error is not None:
            raise self._error

    def at_rest(self) -> bool:
        return self._clock.now_ns() >= self._rest_ns


class Bench:
    """A stop procedure of two arms and other devices, and all that it tells of them."""

    def __init__(self, left: dict[str, Any], devices: dict[str, Any] | None = None, beat: bool = True) -> None:
        self.clock = VirtualClock(10**9)
        self.beats_ns: list[int] = []
        self.events: list[tuple[str, str]] = []
        self.states: list[str] = []
        self.latch = unlogged_latch()
        self.arms = {"left": Arm(self.clock, **left), "right": Arm(self.clock, lambda category: 0.05)}
        self._beat_works = beat
        cell = SimpleNamespace(
            clock=self.clock,
            rate_hz=100.0,
            stop_categories=dict.fromkeys(self.arms, StopCategory.STOP_AND_HOLD),
            holding=(),
            auxiliaries=devices or {},
            supervisor=SimpleNamespace(latch=self.latch),
            watchdog=SimpleNamespace(beat=self._beat),
        )
        record = SimpleNamespace(
            event=lambda name, text: self.events.append((name, text)),
            state=lambda role, state: self.states.append(role),
        )
        self.procedure = StopProcedure(cast(Any, cell), cast(Any, self.arms), cast(Any, record))

    def _beat(self) -> None:
        self.beats_ns.append(self.clock.now_ns())
        if not self._beat_works:
            raise BrokenPipeError("the watchdog is gone")

    def stopped(self) -> None:
        self.procedure.begin(tripped=True)
        self.procedure.await_rest()


def test_the_watchdog_is_told_in_every_cycle_of_a_stop_and_all_states_are_recorded() -> None:
    bench = Bench({"rest_s": lambda category: 0.08})
    bench.stopped()
    assert set(np.diff(bench.beats_ns).tolist()) == {0, 10_000_000}
    assert bench.beats_ns[-1] - bench.beats_ns[0] == 80_000_000
    assert bench.states.count("left") == 9
    assert bench.states.count("right") == 6
    assert bench.events == []
    assert not bench.latch.causes


def test_a_watchdog_that_is_gone_ends_no_stop(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench({"rest_s": lambda category: 0.08}, beat=False)
    with caplog.at_level(logging.ERROR):
        bench.stopped()
    assert bench.states.count("left") == 9
    assert "the watchdog was not told" in caplog.text
    assert bench.arms["left"].at_rest()


def test_an_arm_that_raises_is_named_in_log_and_record_and_the_other_is_stopped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench({"rest_s": lambda category: 0.0, "error": OSError("broken pipe")})
    with caplog.at_level(logging.ERROR):
        bench.stopped()
    assert "left could not be told to stop" in caplog.text
    assert bench.events == [("stop failed", "left: OSError('broken pipe')")]
    assert bench.arms["right"].stops == [StopCategory.STOP_AND_HOLD]


def test_an_arm_that_obeys_only_a_stronger_stop_is_escalated_and_latched_as_a_fault() -> None:
    bench = Bench({"rest_s": lambda category: 1e3 if category is StopCategory.STOP_AND_HOLD else 0.0})
    bench.stopped()
    assert bench.arms["left"].stops == [StopCategory.STOP_AND_HOLD, StopCategory.REMOVE_POWER]
    (event,) = bench.events
    assert event[0] == "escalated"
    assert event[1].startswith(f"left: not seen at rest {STOP_MARGIN_S:.3f} s after a stop by category 2")
    (cause,) = bench.latch.causes
    assert (cause.interlock, cause.subject, cause.severity) == ("stop", "left", Severity.FAULT)
    assert cause.limit == pytest.approx(STOP_MARGIN_S)
    assert cause.value is not None
    assert cause.value >= STOP_MARGIN_S


def test_an_arm_that_obeys_nothing_is_reported() -> None:
    bench = Bench({"rest_s": lambda category: 1e3})
    bench.stopped()
    assert [name for name, _ in bench.events] == ["escalated", "stop failed"]
    assert "use the emergency stop" in bench.events[1][1]
    assert bench.events[1][1].startswith("left: ")


def test_an_arm_that_is_distrusted_is_stopped_by_the_strongest_category() -> None:
    bench = Bench({"rest_s": lambda category: 0.0})
    causes = [
        Violation("tracking", Severity.FAULT, "left", "off", bench.clock.now_ns()),
        Violation("depth", Severity.TRIP, "right", "deep", bench.clock.now_ns()),
    ]
    bench.latch.update(causes)
    bench.stopped()
    assert bench.arms["left"].stops == [StopCategory.REMOVE_POWER]
    assert bench.arms["right"].stops == [StopCategory.STOP_AND_HOLD]


def test_a_run_that_is_merely_done_stops_and_holds() -> None:
    bench = Bench({"rest_s": lambda category: 0.0})
    bench.procedure.begin(tripped=False)
    assert bench.arms["left"].stops == [StopCategory.STOP_AND_HOLD]


class Deaf(Turntable):
    """Cannot be told to stop."""

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        raise DeviceFault("turntable", "deaf")


class Lamp(Device):
    """Has no stop."""

    def _open(self) -> None: ...

    def _close(self) -> None: ...


def test_devices_are_given_two_seconds_and_only_once() -> None:
    assert DEVICE_REST_S == 2.0
    clock = VirtualClock(10**9)
    table = Deaf(clock, 1e9)
    bench = Bench({"rest_s": lambda category: 0.0}, {"table": table, "lamp": Lamp("lamp", clock)})
    table._clock = bench.clock
    began_ns = bench.clock.now_ns()
    bench.stopped()
    assert bench.clock.now_ns() - began_ns == 2_000_000_000
    assert [name for name, _ in bench.events] == ["stop failed", "stop failed"]
    assert "deaf" in bench.events[0][1]
    assert bench.events[1][1] == "table: still moves 2 s after a stop: use the emergency stop"
    # The watchdog knows all the while that the loop lives.
    assert np.diff([*bench.beats_ns, bench.clock.now_ns()]).max() <= 10_000_000
    assert [cause.subject for cause in bench.latch.causes] == ["table"]
    asked = len(table.asked_ns)
    bench.procedure.await_rest()
    assert len(table.asked_ns) == asked


def test_a_device_that_comes_to_rest_in_time_is_no_fault() -> None:
    table = Turntable(VirtualClock(), 1.5)
    bench = Bench({"rest_s": lambda category: 0.0}, {"table": table})
    table._clock = bench.clock
    began_ns = bench.clock.now_ns()
    bench.stopped()
    assert bench.clock.now_ns() - began_ns == 1_500_000_000
    assert bench.events == []
    assert not bench.latch.causes
