"""Every state of a run meets every event and every stimulus: what is allowed does what it must, the rest is refused."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.operated_run import OperatedRun, waiting_cell
from touchcell.cell.recording.message_types import Encoded
from touchcell.cell.runtime import diagrams
from touchcell.cell.runtime.operator_channel import OperatorRequest
from touchcell.cell.runtime.run_result import Outcome
from touchcell.cell.runtime.run_states import FINISHED, RESUME, STARTED, STOPPED, TIMEOUT, RunState, run_table
from touchcell.drivers.core.errors import DeviceFault
from touchcell.drivers.core.protocols import StopCategory
from touchcell.geometry.types import Array
from touchcell.tasks.interface import Observation
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, Accepted, TaskMachine, lint

STARTING, RUNNING, STOPPING, WAITING, ENDED = RunState

# Written from docs/explanation/architecture.md: what each event does where it does anything.
ALLOWED: Mapping[tuple[RunState, str], RunState] = {
    (STARTING, STARTED): RUNNING,
    (RUNNING, FINISHED): STOPPING,
    (STOPPING, STOPPED): ENDED,
    (WAITING, RESUME): RUNNING,
    **{
        (state, event): STOPPING
        for state in (STARTING, RUNNING, STOPPING, WAITING)
        for event in (STOP, TRIP, FAULT, TIMEOUT)
    },
}
EVENTS = (STARTED, FINISHED, STOPPED, RESUME, STOP, TRIP, FAULT, TIMEOUT)
WAYS = {
    STARTING: (),
    RUNNING: (STARTED,),
    STOPPING: (STARTED, STOP),
    WAITING: (STARTED, TRIP, STOPPED),
    ENDED: (STARTED, STOP, STOPPED),
}


class Guards:
    """The loop's side of the table, with answers that the test chooses."""

    def __init__(self) -> None:
        self.may_wait = self.clear = True
        self.entered: list[str] = []

    def waits_for_reset(self) -> bool:
        return self.may_wait

    def latch_is_clear(self) -> bool:
        return self.clear

    def enter_running(self, record: Any) -> None:
        self.entered.append("running")

    def enter_stopping(self, record: Any) -> None:
        self.entered.append("stopping")

    def enter_waiting(self, record: Any) -> None:
        self.entered.append("waiting")


def machine_in(state: RunState) -> tuple[TaskMachine, Guards]:
    guards = Guards()
    machine = TaskMachine(run_table(10.0), guards)
    guards.may_wait = state is WAITING
    for event in WAYS[state]:
        machine.fire(event, now_ns=0)
    assert machine.state is state
    guards.entered.clear()
    return machine, guards


def test_the_table_has_no_fault_that_lint_finds() -> None:
    assert lint(run_table(10.0), Guards()) == []


@pytest.mark.parametrize(("state", "event"), list(itertools.product(RunState, EVENTS)))
@pytest.mark.parametrize("may_wait", [False, True])
@pytest.mark.parametrize("clear", [False, True])
def test_every_state_meets_every_event(state: RunState, event: str, may_wait: bool, clear: bool) -> None:
    machine, guards = machine_in(state)
    guards.may_wait, guards.clear = may_wait, clear
    answer = machine.fire(event, now_ns=0)
    expected = ALLOWED.get((state, event))
    if (state, event) == (STOPPING, STOPPED) and may_wait:
        expected = WAITING
    if (state, event) == (WAITING, RESUME) and not clear:
        expected = None
    assert isinstance(answer, Accepted) == (expected is not None)
    assert machine.state is (expected or state)
    entered = {RUNNING: ["running"], STOPPING: ["stopping"], WAITING: ["waiting"]}
    assert guards.entered == ([] if expected is None else entered.get(expected, []))


def test_a_state_that_lasts_too_long_is_stopped() -> None:
    for state in (STARTING, RUNNING, WAITING):
        machine, _ = machine_in(state)
        machine.tick(0)
        machine.tick(10**18)
        assert machine.state is STOPPING


def test_the_diagram_in_the_documentation_is_that_of_the_code() -> None:
    page = diagrams.PAGE.read_text(encoding="utf-8")
    assert diagrams.redrawn(page) == page, "run: python -m touchcell.cell.runtime.diagrams"
    assert "waiting_for_reset" in page


class Watched:
    """A run, with everything that its arm is told, and a stimulus that may come while it is stopping."""

    def __init__(self, folder: Path) -> None:
        self.told: list[str] = []
        self.while_stopping: Callable[[], None] | None = None
        cell = waiting_cell(max_duration_s=30.0)
        cell["task"]["distance_mm"] = 400
        self.run = OperatedRun(folder, cell, box=self)
        self.state = lambda: self.run.loop.state
        follow, stop = self.run.arm._body.follow, self.run.arm.stop

        def followed(twist: Array, expires_ns: int) -> None:
            assert self.state() is RUNNING, f"a motion is commanded while {self.state().name}"
            self.told.append("twist" if np.any(twist) else "zero")
            follow(twist, expires_ns)

        def stopped(category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
            if self.state() is not RUNNING:
                self.told.append("stop")
            stop(category)

        self.run.arm._body.follow = followed  # type: ignore[method-assign]
        self.run.arm.stop = stopped  # type: ignore[method-assign]

    def add(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        if self.state() is STOPPING and self.while_stopping is not None:
            stimulus, self.while_stopping = self.while_stopping, None
            stimulus()

    def to(self, state: str) -> None:
        """Bring the run into ``state``, its arm in motion where that is allowed."""
        if state == "starting":
            return
        self.run.until("approach")
        self.run.go(10)
        assert "twist" in self.told
        if state.startswith("waiting"):
            self.run.fault(nan_state=True)
            self.run.go(1)
            self.run.fault(nan_state=False)
            self.run.go(3)
            assert self.state() is WAITING
        if state == "waiting, reset":
            assert self.run.ask(OperatorRequest.RESET).startswith("reset")
        if state == "ended":
            self.run.stop.ask_at_once()
            self.run.go(1)

    def stimulate(self, stimulus: str) -> None:
        run = self.run
        if stimulus == "orderly stop":
            run.stop.ask()
        elif stimulus == "stop at once":
            run.stop.ask_at_once()
        elif stimulus == "trip":
            run.fault(nan_state=True)
        elif stimulus == "device fault":
            run.arm._to_faulted(DeviceFault("arm", "it complains"))
        elif stimulus == "mistake in the task":

            def tick(observation: Observation) -> None:
                raise ValueError("mistake")

            run.cell.task.tick = tick  # type: ignore[method-assign, assignment]
        elif stimulus == "time passes":
            run.cell.clock.sleep_until_ns(run.cell.clock.now_ns() + round(31e9))
        elif stimulus == "end":
            run.loop.end()
        else:
            run.channel.ask(OperatorRequest(stimulus), "ada")

    def settle(self) -> None:
        self.run.go(300)


STIMULI = (
    "orderly stop",
    "stop at once",
    "trip",
    "device fault",
    "mistake in the task",
    "time passes",
    "end",
    "reset",
    "resume",
)
# Where a run is some time after a stimulus; whatever is not here leaves it where it was.
SETTLES: Mapping[tuple[str, str], RunState] = {
    **{
        (state, stimulus): ENDED
        for state in ("starting", "running", "waiting", "waiting, reset")
        for stimulus in STIMULI[:2]
    },
    **{(state, "end"): ENDED for state in ("starting", "running", "waiting", "waiting, reset")},
    **{(state, stimulus): WAITING for state in ("starting", "running") for stimulus in ("trip", "device fault")},
    **{(state, "mistake in the task"): ENDED for state in ("starting", "running")},
    ("running", "time passes"): ENDED,
    ("waiting, reset", "resume"): RUNNING,
}
STATES = {
    "starting": RUNNING,
    "running": RUNNING,
    "waiting": WAITING,
    "waiting, reset": WAITING,
    "ended": ENDED,
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("stimulus", STIMULI)
def test_every_state_meets_every_stimulus(tmp_path: Path, state: str, stimulus: str) -> None:
    watched = Watched(tmp_path)
    run = watched.run
    watched.to(state)
    before, pose = list(watched.told), run.pose()
    watched.stimulate(stimulus)
    watched.settle()
    assert watched.state() is SETTLES.get((state, stimulus), STATES[state])
    if STATES[state] is not RUNNING and watched.state() is not RUNNING:
        # Neither a wait nor a reset nor anything after the end moves an arm.
        np.testing.assert_array_equal(run.pose(), pose)
        assert "twist" not in watched.told[len(before) :]
    result = run.end()
    assert watched.state() is ENDED
    if "twist" in watched.told:
        assert "stop" in watched.told[len(watched.told) - watched.told[::-1].index("twist") :]
    report = result.stops["arm"]
    assert report.problem or report.time_s is not None
    if not report.problem:
        assert run.arm.owner is None
    assert run.arm._body.at_rest()
    assert not run.loop.step()


@pytest.mark.parametrize("stimulus", [each for each in STIMULI if each not in ("end", "time passes")])
@pytest.mark.parametrize("first", ["trip", "stop at once"])
def test_whatever_comes_while_it_stops_the_arms_are_watched_to_rest(tmp_path: Path, first: str, stimulus: str) -> None:
    watched = Watched(tmp_path)
    watched.to("running")
    watched.while_stopping = lambda: watched.stimulate(stimulus)
    watched.stimulate(first)
    watched.run.go(1)
    watched.run.fault(nan_state=False)
    assert watched.while_stopping is None
    watched.settle()
    waits = first == "trip" and stimulus not in ("orderly stop", "stop at once")
    assert watched.state() is (WAITING if waits else ENDED)
    result = watched.run.end()
    assert result.outcome is (Outcome.TRIPPED if first == "trip" else Outcome.STOPPED)
    assert watched.run.arm._body.at_rest()
    assert watched.state() is ENDED
