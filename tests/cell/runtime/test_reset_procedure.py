"""What a reset and a resume do to devices, leases and watchdog, and in which order."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchcell.cell.runtime.operator_channel import OperatorRequest, Request
from touchcell.cell.runtime.reset_procedure import ResetProcedure
from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch, LatchState
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import DeviceFault, DeviceGone
from touchcell.drivers.core.samples import Stamped, TcpState

VIEW = CellView(2_000, {"arm": ArmView(Stamped(TcpState(np.eye(4), np.zeros(6)), 2_000, 1))}, {})
TRIP = Violation("depth", Severity.TRIP, "sensor", "too deep", 1_000)


class Bench:
    """A cell of stubs that write down what is done to them, and a channel that asks what a test says."""

    def __init__(self, *asks: OperatorRequest) -> None:
        self.done: list[str] = []
        self.asks = list(asks)
        self.answers: list[tuple[str, bool, str]] = []
        self.failing: dict[str, Exception] = {}
        self.latch = Latch()
        self.devices = {name: self._device(name) for name in ("arm", "camera", "gripper")}
        self.devices["arm"].owner = "task"
        watchdog = SimpleNamespace(
            clear=self._act("clear"), begin=self._act("begin"), alarms=lambda now_ns: self.alarms
        )
        self.alarms: tuple[Violation, ...] = ()
        self.cell: Any = SimpleNamespace(
            arms={"arm": self.devices["arm"]},
            cameras={"camera": self.devices["camera"]},
            auxiliaries={"gripper": self.devices["gripper"]},
            clock=SimpleNamespace(now_ns=lambda: 3_000),
            supervisor=Supervisor([], self.latch),
            watchdog=watchdog,
            task_name="task",
        )
        self.leases: dict[str, Any] = {"arm": "first lease"}
        self.procedure = ResetProcedure(self.cell, self.leases, self)  # type: ignore[arg-type]

    def _act(self, what: str) -> Any:
        def act(*arguments: Any) -> Any:
            if what in self.failing:
                raise self.failing[what]
            self.done.append(what)
            return "new lease"

        return act

    def _device(self, name: str) -> Any:
        verbs = {verb: self._act(f"{verb} {name}") for verb in ("recover", "activate", "acquire", "release")}
        return SimpleNamespace(state=Lifecycle.ACTIVE, owner=None, **verbs)

    def trip(self, *, gone: bool = True) -> None:
        self.latch.update([TRIP])
        if gone:
            self.latch.update([])

    def take(self) -> Request | None:
        return Request(self.asks.pop(0), "ada") if self.asks else None

    def answer(self, request: Request, done: bool, words: str) -> None:
        self.answers.append((request.ask.value, done, words))


RESET, RESUME = OperatorRequest.RESET, OperatorRequest.RESUME


def test_a_reset_takes_the_leases_back_before_the_watchdog_is_cleared_and_is_answered() -> None:
    bench = Bench(RESET)
    bench.trip()
    assert bench.procedure.answer(VIEW) == (False, ["reset by ada: reset; nothing moves until `touchcell resume`"])
    assert bench.done == ["release arm", "clear"]
    assert bench.latch.state is LatchState.CLEAR
    assert bench.answers == [("reset", True, "reset; nothing moves until `touchcell resume`")]


def test_while_the_cause_is_present_leases_and_watchdog_stay_as_they_are() -> None:
    bench = Bench(RESET)
    bench.trip(gone=False)
    bench.alarms = (TRIP,)
    assert not bench.procedure.answer(VIEW)[0]
    assert bench.done == []
    assert bench.answers == [("reset", False, "refused: a cause is still present")]


def test_nothing_latched_is_refused_and_changes_nothing() -> None:
    bench = Bench(RESET)
    bench.procedure.answer(VIEW)
    assert (bench.done, bench.answers) == ([], [("reset", False, "refused: nothing is latched")])


def test_without_a_view_a_reset_is_refused_but_a_faulted_device_recovered() -> None:
    bench = Bench(RESET)
    bench.trip()
    bench.devices["camera"].state = Lifecycle.FAULTED
    bench.procedure.answer(None)
    assert bench.done == ["recover camera"]
    assert bench.latch.state is LatchState.CAUSE_GONE
    ((ask, done, words),) = bench.answers
    assert (ask, done) == ("reset", False)
    assert "does not answer yet" in words


@pytest.mark.parametrize("name", ["arm", "camera", "gripper"])
def test_every_kind_of_device_is_recovered_and_activated(name: str) -> None:
    bench = Bench(RESET)
    bench.trip()
    bench.devices[name].state = Lifecycle.FAULTED
    bench.procedure.answer(VIEW)
    assert bench.done == [f"recover {name}", "release arm", "clear"]
    bench.devices[name].state = Lifecycle.READY
    bench.asks, bench.done[:] = [RESUME], []
    assert bench.procedure.answer(VIEW)[0]
    assert bench.done == [f"activate {name}", "begin"]


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("recover camera", DeviceFault("camera", "hot")),
        ("release arm", DeviceGone("arm", "cable")),
        ("clear", DeviceFault("watchdog", "silent")),
    ],
)
def test_a_device_that_fails_on_the_way_refuses_the_reset(place: str, error: Exception) -> None:
    bench = Bench(RESET)
    bench.trip()
    bench.devices["camera"].state = Lifecycle.FAULTED
    bench.failing[place] = error
    assert not bench.procedure.answer(VIEW)[0]
    assert bench.answers == [("reset", False, f"refused: {error}")]
    assert bench.latch.state is LatchState.CAUSE_GONE
    assert bench.procedure.resets == []


def test_a_resume_acquires_only_leases_that_were_given_back() -> None:
    bench = Bench(RESUME)
    bench.procedure.answer(VIEW)
    assert bench.done == ["begin"]
    assert bench.leases == {"arm": "first lease"}
    bench.devices["arm"].owner = None
    bench.asks = [RESUME]
    bench.procedure.answer(VIEW)
    assert bench.done == ["begin", "acquire arm", "begin"]
    assert bench.leases == {"arm": "new lease"}


def test_a_resume_before_the_reset_is_refused_and_activates_nothing() -> None:
    bench = Bench(RESUME)
    bench.trip()
    bench.devices["arm"].state = Lifecycle.READY
    assert not bench.procedure.answer(VIEW)[0]
    assert (bench.done, bench.answers) == ([], [("resume", False, "refused: reset first")])


def test_a_resume_that_a_device_refuses_is_refused() -> None:
    bench = Bench(RESUME)
    bench.devices["arm"].state = Lifecycle.READY
    bench.failing["activate arm"] = DeviceFault("arm", "hot")
    assert not bench.procedure.answer(VIEW)[0]
    assert bench.done == []


def test_what_is_asked_after_a_resume_waits() -> None:
    bench = Bench(RESET, RESUME, RESET)
    bench.trip()
    resumed, done = bench.procedure.answer(VIEW)
    assert resumed
    assert len(done) == 2
    assert bench.asks == [RESET]


def test_the_operator_is_shown_the_cause_and_what_to_do_next() -> None:
    bench = Bench()
    bench.trip(gone=False)
    assert bench.procedure.describe() == "depth: sensor: too deep; the cause is still there"
    bench.latch.update([])
    assert bench.procedure.describe() == "depth: sensor: too deep; r resets"
    bench.asks = [RESET]
    bench.procedure.answer(VIEW)
    assert "touchcell resume" in bench.procedure.describe()
