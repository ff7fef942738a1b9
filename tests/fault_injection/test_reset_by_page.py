"""A reset from the operator's page never moves an arm: in every state of every task, whatever the operator answers.

The page's own handlers are called as its buttons call them. What they ask goes through the run's socket and its
signals, and the run is stepped in simulated time where its side of the socket has something to read.
"""

from __future__ import annotations

import asyncio
import select
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.fault_injection.fault_matrix import SETTINGS_OF_STATES, cells, composed, on_true_contact
from tests.helpers.sampling import sampled
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest
from touchcell.cell.runtime.operator_input import reachable, stop_on_signals
from touchcell.cell.runtime.run_result import Outcome
from touchcell.cell.runtime.run_states import RunState
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.ui.runs import Runs
from touchcell.control.latch import LatchState
from touchcell.geometry.types import Array
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.faults import ArmFaults
from touchcell.tasks.state_machine_task import MachineTask

page: Any = pytest.importorskip("touchcell.cell.ui.page", reason="pip install 'touchcell[ui]'")
TRIPS = {"nan_state": ArmFaults(nan_state=True), "stale": ArmFaults(stale=True)}
"""Faults that trip in every state and can pass."""
UNREACHED = {"check": "nothing is checked on the true contact", "return": "no contact is lost there"}
AFTER_STOP = frozenset({"withdraw, steps", "retract, data_collection"})
"""States that last only after an operator's stop: a trip ends the run there, and nothing is left to resume."""
_STOPPED_AFTER_S = 0.8
_SETTLED_CYCLES = 5
_WATCHED_CYCLES = 20
_FEW_CYCLES = 2
"""Where the surface moves on: an arm that stands would soon be pressed against it, and trip again."""
_LONGEST_CYCLES = 4000
_DEADLINE_S = 60.0
TASKS = {name: on_true_contact(data) for name, data in cells().items() if data.get("interlocks") and name != "observe"}


class OperatedByPage:
    """A run that waits for a reset when it trips, and the handlers of the page that shows it.

    Attributes:
        said: what the page told its operator.
        told: motions that arms were commanded, since it was last cleared.
        wrong: commands that came while the run was in another state than running.
    """

    def __init__(self, folder: Path, data: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
        folder.mkdir()
        path = folder / "cell.yaml"
        path.write_text(yaml.safe_dump({**data, "on_trip": "wait_for_reset", "max_duration_s": 600.0}))
        self.cell: Cell = composed(path)
        self.channel = OperatorChannel(folder)
        self.stop = StopRequest()
        self.loop = RunLoop(self.cell, None, stop=self.stop, channel=self.channel)
        self.said: list[str] = []
        self.told: list[str] = []
        self.wrong: list[str] = []
        self.answer = False
        self.page = object.__new__(page.RunPage)
        self.page._runs, self.page._name = Runs(folder.parent, folder.parent), folder.name
        monkeypatch.setattr(page, "_confirmed", self._confirmed)
        monkeypatch.setattr(page.ui, "notify", lambda text: self.said.append(text))
        monkeypatch.setattr(page.background, "io_bound", asyncio.to_thread)
        self.arms = {role: arm for role, arm in self.cell.arms.items() if isinstance(arm, SimArm)}
        assert len(self.arms) == len(self.cell.arms) > 0
        for role, arm in self.arms.items():
            self._watch(role, arm)

    async def _confirmed(self, question: str, action: str) -> bool:
        return self.answer

    def _watch(self, role: str, arm: SimArm) -> None:
        body: Any = arm._body
        follow = body.follow

        def followed(twist: Array, expires_ns: int) -> None:
            if self.loop.state is not RunState.RUNNING:
                # Not raised here: the loop would take it for a fault of the driver.
                self.wrong.append(f"{role} is commanded while the run is {self.loop.state.name}")
            if np.any(twist):
                self.told.append(role)
            follow(twist, expires_ns)

        body.follow = followed

    def until(self, reached: Callable[[], bool]) -> None:
        for _ in range(_LONGEST_CYCLES):
            if reached():
                return
            assert self.loop.step(), f"the run has ended: {self.loop.result.reason}"
        raise AssertionError(f"{self.cell.task.state}, {self.loop.state.name}")

    def fault(self, faults: ArmFaults) -> None:
        next(iter(self.arms.values())).faults = faults

    def press(self, request: OperatorRequest, *, confirmed: bool) -> str:
        """Press a button, answer the question, and step the run until the page has a reply; "" if it asked nothing."""
        self.answer = confirmed
        self.said.clear()
        pressed = threading.Thread(target=lambda: asyncio.run(self.page._ask(request)))
        pressed.start()
        while pressed.is_alive():
            sockets = [each for each in (self.channel._server, *self.channel._clients) if each is not None]
            if sockets and select.select(sockets, [], [], 0.01)[0]:
                self.loop.step()
        pressed.join()
        return self.said[0] if self.said else ""

    def poses(self) -> list[Array]:
        return [arm.T_world_tcp().copy() for arm in self.arms.values()]


@contextmanager
def operated(folder: Path, data: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[OperatedByPage]:
    with ExitStack() as stack:
        run = OperatedByPage(folder, data, monkeypatch)
        stack.enter_context(run.cell)
        stack.enter_context(reachable(folder))
        stack.enter_context(stop_on_signals(run.stop))
        run.loop.begin()
        yield run
        assert run.loop.end().outcome is not Outcome.ERROR
        run.channel.close()


def states(task: str, folder: Path) -> list[str]:
    path = folder / "probe.yaml"
    path.write_text(yaml.safe_dump(TASKS[task]))
    probe = composed(path).task
    assert isinstance(probe, MachineTask)
    return [state for state in probe.states if state not in UNREACHED]


def run_state(run: OperatedByPage) -> RunState:
    return run.loop.state


def latch_state(run: OperatedByPage) -> LatchState:
    return run.cell.supervisor.latch.state


def reset_moves_nothing(run: OperatedByPage, state: str, faults: ArmFaults) -> None:
    """Trip in a state, and go through every answer that an operator can give."""
    after_stop = f"{state}, {run.cell.task_name}" in AFTER_STOP
    if after_stop:
        run.until(lambda: run.cell.clock.now_ns() > run.cell.start_ns + _STOPPED_AFTER_S * 1e9)
        run.stop.ask()
    run.until(lambda: run.cell.task.state == state)
    for _ in range(_SETTLED_CYCLES):
        if run.cell.task.state == state:
            run.loop.step()
    run.fault(faults)
    if after_stop:
        while run.loop.step():
            pass
        stood, run.told[:] = run.poses(), []
        assert "no answer" in run.press(OperatorRequest.RESET, confirmed=True)
        assert "no answer" in run.press(OperatorRequest.RESUME, confirmed=True)
        assert run.told == run.wrong == []
        assert np.array_equal(run.poses(), stood)
        return
    run.until(lambda: run.loop.state is RunState.WAITING_FOR_RESET)
    stood, run.told[:] = run.poses(), []

    watched = _FEW_CYCLES if run.cell.task_name == "object_tracking" else _WATCHED_CYCLES

    def nothing_moved(times: int = 1) -> None:
        for _ in range(times * watched):
            assert run.loop.step()
        assert run_state(run) is RunState.WAITING_FOR_RESET
        assert run.told == run.wrong == []
        assert np.abs(np.array(run.poses()) - np.array(stood)).max() < 1e-12

    assert "refused" in run.press(OperatorRequest.RESET, confirmed=True), "the cause is still there"
    nothing_moved()
    run.fault(ArmFaults())
    nothing_moved()
    assert "refused: reset first" in run.press(OperatorRequest.RESUME, confirmed=True)
    nothing_moved()
    assert run.press(OperatorRequest.RESET, confirmed=False) == ""
    assert latch_state(run) is LatchState.CAUSE_GONE
    nothing_moved()
    reply = run.press(OperatorRequest.RESET, confirmed=True)
    if "ask again" in reply:
        nothing_moved()
        reply = run.press(OperatorRequest.RESET, confirmed=True)
    assert reply == "reset; nothing moves until `touchcell resume`"
    assert latch_state(run) is LatchState.CLEAR
    nothing_moved(5)
    assert run.press(OperatorRequest.RESET, confirmed=True).startswith("refused")
    nothing_moved()
    assert run.press(OperatorRequest.RESUME, confirmed=False) == ""
    nothing_moved()
    assert run.press(OperatorRequest.RESUME, confirmed=True) == "the task starts again from its first state"
    assert run_state(run) is RunState.RUNNING
    assert run.wrong == []


@pytest.mark.slow
@pytest.mark.parametrize(("task", "trip"), sampled(product(TASKS, TRIPS), len(TASKS) + 1))
def test_nothing_moves_between_a_trip_in_any_state_and_a_confirmed_resume(
    task: str, trip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = states(task, tmp_path)
    assert len(tried) >= 3
    for state in tried:
        data = {**TASKS[task], "task": {**TASKS[task]["task"], **SETTINGS_OF_STATES.get(state, {})}}
        with operated(tmp_path / state, data, monkeypatch) as run:
            reset_moves_nothing(run, state, TRIPS[trip])


def test_after_a_confirmed_resume_the_arm_moves_and_the_pages_stop_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other side: what the matrix asserts would not hold if the run had not gone on."""
    with operated(tmp_path / "run", TASKS["surface_following"], monkeypatch) as run:
        reset_moves_nothing(run, "approach", TRIPS["stale"])
        run.until(lambda: bool(run.told))
        run.page._stop(at_once=True)
        assert run.said[-1] == "asked to stop at once"
        while run.loop.step():
            pass
        assert all(arm.at_rest() for arm in run.arms.values())


def test_the_matrix_detects_a_reset_that_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with operated(tmp_path / "run", TASKS["surface_following"], monkeypatch) as run:
        reset = run.cell.supervisor.reset

        def moves_too(*arguments: Any) -> Any:
            for arm in run.arms.values():
                arm._body.follow(np.array([0.01, 0, 0, 0, 0, 0]), run.cell.clock.now_ns() + 10**9)
            return reset(*arguments)

        monkeypatch.setattr(run.cell.supervisor, "reset", moves_too)
        with pytest.raises(AssertionError):
            reset_moves_nothing(run, "approach", TRIPS["stale"])
        assert run.wrong == ["arm is commanded while the run is WAITING_FOR_RESET"]
