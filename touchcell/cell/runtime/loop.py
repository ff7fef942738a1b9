"""The control cycle: read the arms, perceive, let the task think, let the supervisor judge, send, record.

One thread. Its states are those of ``touchcell.cell.runtime.run_states``. Whatever goes wrong, all arms are commanded
to stop before anything else happens, each is watched until it stands, and the run ends in a report, or waits for the
operator if its cell file asks for it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import cast

from touchcell.cell.errors import UnexpectedError
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.observer import Observer, call_driver
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.pacing import Pacing
from touchcell.cell.runtime.reset_procedure import ResetProcedure
from touchcell.cell.runtime.run_record import Box, RunRecord
from touchcell.cell.runtime.run_result import Outcome, Progress, RunResult
from touchcell.cell.runtime.run_states import FINISHED, RESUME, STARTED, STOPPED, TIMEOUT, RunState, run_table
from touchcell.cell.runtime.stop_procedure import StopProcedure
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.stopping import StopReport
from touchcell.cell.runtime.timing import CycleTimes
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import LatchState
from touchcell.control.supervisor import Verdict
from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.errors import ConnectError, DeviceError, DeviceGone
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import ServoArm, SettingSink, TwistSink
from touchcell.errors import TouchcellError
from touchcell.tasks.interface import Action, Conditional, Observation, Task, TransitionRecord
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, TaskMachine, state_name

logger = logging.getLogger(__name__)


class RunLoop:
    """Runs a composed cell's task to its end: ``run``, or ``begin``, ``step`` while it returns True, and ``end``.

    Args:
        cell: built and activated.
        recorder: where everything is recorded; None records nothing.
        box: keeps the latest messages in memory.
        stop: read in every cycle.
        on_cycle: called after every cycle, for a live display.
        channel: where an operator may reset a run that has tripped; without one it ends, whatever the cell file says.
        on_trip: called with what is known when the arms stand and the run begins to wait.
    """

    def __init__(
        self,
        cell: Cell,
        recorder: Recorder | None,
        *,
        box: Box | None = None,
        stop: StopRequest | None = None,
        on_cycle: Callable[[Progress], None] | None = None,
        channel: OperatorChannel | None = None,
        on_trip: Callable[[RunResult], None] | None = None,
    ) -> None:
        self._cell = cell
        self._stop = stop or StopRequest()
        self._on_cycle = on_cycle
        self._on_trip = on_trip
        self._times = CycleTimes()
        self._arms = {role: cast(ServoArm, arm) for role, arm in cell.arms.items() if isinstance(arm, TwistSink)}
        self._leases: dict[str, Lease] = {}
        self._record = RunRecord(cell, recorder, box)
        self._observer = Observer(cell, self._times)
        self._stops = StopProcedure(cell, self._arms, self._record)
        self._channel = channel if cell.plan.cell.on_trip == "wait_for_reset" else None
        self._reset = None if self._channel is None else ResetProcedure(cell, self._leases, self._channel)
        self._pacing = Pacing(cell.clock, cell.rate_hz)
        self._machine = TaskMachine(run_table(cell.max_duration_s), self)
        self._start_ns = cell.clock.now_ns()
        self._cycles = 0
        self._sent: Mapping[str, Sent[TwistCommand]] = {}
        self._error: TouchcellError | None = None
        self._lost = False
        self._reports: Mapping[str, StopReport] = {}
        self._final: RunResult | None = None

    @property
    def state(self) -> RunState:
        """Where the run is."""
        return cast(RunState, self._machine.state)

    @property
    def has_waited(self) -> bool:
        """Whether the latest trip has been reported to ``on_trip``."""
        return _has_waited(self._machine.records)

    @property
    def result(self) -> RunResult:
        """How the run stands, or how it ended."""
        return self._final or self._result()

    def run(self) -> RunResult:
        """Run until the task has finished, the supervisor has tripped, or something has failed. Never raises for what
        devices, tasks, data or disk do: that ends in a result, with the arms commanded to stop."""
        try:
            while self.step():
                pass
        finally:
            result = self.end()
        return result

    def begin(self) -> None:
        """Wait for each camera's first frame, take the arms' leases, and be watched from now on."""
        cell = self._cell
        try:
            self._observer.await_frames()
            self._record.begin()
            for role, arm in self._arms.items():
                self._leases[role] = call_driver(arm.name, partial(arm.acquire, cell.task_name))
            if cell.scene is not None:
                # In real time it has to catch up with all that happened since it was made.
                cell.scene.objects()
            cell.watchdog.begin()
        except BaseException as error:
            self._fail(error)
        self._start_ns = cell.clock.now_ns()
        self._fire(STARTED)
        self._pacing.restart()

    def step(self) -> bool:
        """One cycle, and the wait for the next; returns whether there is to be one.

        A stop that the cycle leads to is seen through until the arms stand.
        """
        if self.state is RunState.STARTING:
            self.begin()
        self._machine.tick(self._cell.clock.now_ns())
        try:
            if self.state is RunState.RUNNING:
                self._work()
            elif self.state is RunState.WAITING_FOR_RESET:
                self._wait()
        except BaseException as error:
            self._fail(error)
        if self.state in (RunState.RUNNING, RunState.WAITING_FOR_RESET) and self._record.error is not None:
            self._fail(self._record.error)
        if self.state is RunState.STOPPING:
            self._await_rest()
        elif self.state is not RunState.ENDED:
            self._pacing.wait()
        return self.state is not RunState.ENDED

    def end(self) -> RunResult:
        """Bring the arms to rest wherever the run is, give them back, and return how it went."""
        while self.state is not RunState.ENDED:
            if self.state is not RunState.STOPPING:
                self._fire(STOP, "ended before the task had finished")
            self._await_rest()
        return self.result

    def enter_running(self, record: TransitionRecord) -> None:
        """Called on entry to RUNNING: after a reset the task begins anew, from its first state."""
        if record.event == RESUME:
            cell = self._cell
            cell.task = cell.resumed_task()
            self._record.new_task()
            self._sent = {}
            self._lost = False
            self._require_channel().close()
            self._pacing.restart()

    def enter_stopping(self, record: TransitionRecord) -> None:
        """Called on entry to STOPPING: all arms are commanded to stop."""
        latch = self._cell.supervisor.latch
        if record.event == FAULT:
            self._error = self._error or TouchcellError(record.reason)
            self._latch_alarms()
        self._stops.begin(tripped=record.event in (TRIP, FAULT) or latch.first_cause is not None)

    def enter_waiting(self, record: TransitionRecord) -> None:
        """Called on entry to WAITING_FOR_RESET: arms that no watchdog guards obey no motion, and the trip is reported
        once."""
        if not _has_waited(self._machine.records[:-1]):
            # A black box takes longer to write than a watchdog waits.
            self._cell.watchdog.end()
            self._require_channel().open()
            self._record.event("waiting", "for a reset")
            if self._on_trip is not None:
                self._on_trip(self._result())
        self._pacing.restart()

    def waits_for_reset(self) -> bool:
        """Whether the run waits for the operator once its arms stand: after a trip, if the cell file asks for it."""
        latched = self._cell.supervisor.latch.first_cause is not None
        return self._reset is not None and latched and self._machine.records[-1].event == TRIP

    def latch_is_clear(self) -> bool:
        """Whether nothing is latched, so that the task may start again."""
        return self._cell.supervisor.latch.state is LatchState.CLEAR

    def _work(self) -> None:
        """One cycle of the task."""
        if self._stop.at_once:
            self._fire(STOP, "stopped at once by the operator")
            return
        self._cell.watchdog.beat()
        self._cycle()
        self._cycles += 1
        if self._cell.task.finished:
            # Refused where the same cycle has tripped.
            self._fire(FINISHED)

    def _cycle(self) -> None:
        cell = self._cell
        started = time.perf_counter_ns()
        reading = self._observer.read()
        perceived = time.perf_counter_ns()
        observation = Observation(
            reading.now_ns,
            reading.states,
            reading.contacts,
            operator_stop=self._stop.orderly,
            ended=self._observer.exhausted,
            devices=reading.devices,
            wrenches=reading.wrenches,
            jog=None if cell.jog_input is None else cell.jog_input.request(reading.now_ns),
        )
        action = cell.task.tick(observation)
        for role in sorted(action.zero):
            if (zero := cell.sensors[role].take_zero()) is not None:
                self._record.zero_frame(role, zero.t_ns, zero.value.image)
        thought = time.perf_counter_ns()
        verdict = cell.supervisor.review(self._observer.view(reading, action, self._sent), self._alarms())
        judged = time.perf_counter_ns()
        if verdict.allow:
            self._sent = self._send(action, verdict)
        else:
            self._sent = {}
            self._fire(TRIP, str(verdict.trip))
            cell.task.trip(reading.now_ns, str(verdict.trip))
        self._record.keep_frames(reading.contacts, action)
        done = time.perf_counter_ns()
        for sensor in cell.sensors.values():
            for stage, duration_ns in sensor.stage_times().items():
                if duration_ns:
                    self._times.add(stage, duration_ns)
        self._times.add("sense", perceived - started)
        self._times.add("task and control", thought - perceived)
        self._times.add("supervisor", judged - thought)
        self._times.add("gate and send", done - judged)
        self._times.add("cycle", done - started)
        self._record.cycle(reading, action, self._sent, verdict, self._times)
        self._times.add("record", time.perf_counter_ns() - done)
        if self._on_cycle is not None:
            t_s = (reading.now_ns - cell.start_ns) * 1e-9
            self._on_cycle(Progress(t_s, cell.task.state, reading.contacts, action.telemetry))

    def _send(self, action: Action, verdict: Verdict) -> Mapping[str, Sent[TwistCommand]]:
        """Send what the task asks for, and stop the arms that it asks nothing of."""
        sent = {}
        for role, command in action.twists.items():
            # A violation that only limits slows everything down, in the direction that it has.
            slowed = command if verdict.speed == 1.0 else replace(command, twist=verdict.speed * command.twist)
            arm = self._arms[role]
            sent[role] = call_driver(arm.name, partial(arm.send_twist, slowed, self._leases[role]))
        for role, arm in self._arms.items():
            if role not in action.twists:
                call_driver(arm.name, arm.stop)
        for role, setting in action.settings.items():
            device = self._cell.auxiliaries[role]
            call_driver(device.name, partial(cast(SettingSink, device).apply, setting))
        return sent

    def _wait(self) -> None:
        """One cycle of a run that has tripped: the arms stand and are watched, and the operator is answered."""
        cell = self._cell
        if self._stop.orderly:
            self._fire(STOP, "ended by the operator after a trip")
            return
        view = None
        try:
            view = self._observer.view(self._observer.read())
            cell.supervisor.review(view, self._alarms())
            if not all(call_driver(arm.name, arm.at_rest) for arm in self._arms.values()):
                self._fire(TRIP, "an arm does not stand while the run waits")
        except DeviceError as error:
            self._fail(error)
        if self.state is RunState.WAITING_FOR_RESET:
            self._answer(view)

    def _answer(self, view: CellView | None) -> None:
        """Answer what the operator has asked, and start the task again if that was asked and may be."""
        assert self._reset is not None
        resume, done = self._reset.answer(view)
        for description in done:
            self._record.event("operator", description)
        if resume:
            self._fire(RESUME)
        if self._on_cycle is not None:
            waiting = "" if resume else self._reset.describe()
            t_s = (self._cell.clock.now_ns() - self._cell.start_ns) * 1e-9
            self._on_cycle(Progress(t_s, self._cell.task.state, {}, {}, waiting))

    def _fail(self, error: BaseException) -> None:
        """Stop because of ``error``; a run that may wait for a reset treats a device's like any other trip."""
        found = error if isinstance(error, TouchcellError) else UnexpectedError(error)
        logger.error("%s: %s", self.state.name.lower(), found, exc_info=error)
        self._lost = self._lost or isinstance(error, DeviceGone | ConnectError)
        at_work = self.state in (RunState.RUNNING, RunState.WAITING_FOR_RESET)
        if isinstance(error, DeviceError) and self._reset is not None and at_work:
            self._distrust(error)
            return
        self._error = self._error or found
        self._fire(FAULT, str(found))

    def _distrust(self, error: DeviceError) -> None:
        """Latch what a device has raised."""
        cell = self._cell
        roles = {arm.name: role for role, arm in cell.arms.items()}
        now_ns, latch = cell.clock.now_ns(), cell.supervisor.latch
        self._latch_alarms()
        fault = Violation("device", Severity.FAULT, roles.get(error.device, error.device), str(error), now_ns)
        is_new = (fault.interlock, fault.subject) not in {(cause.interlock, cause.subject) for cause in latch.causes}
        latch.update([fault])
        if is_new:
            self._fire(TRIP, str(error))
        with _logged("the task was not told of the trip"):
            if not cell.task.finished:
                cell.task.trip(now_ns, str(error))

    def _latch_alarms(self) -> None:
        """Latch what the watchdog has found, which may know better why a device does not answer."""
        with _logged("the watchdog was not asked"):
            if alarms := self._alarms():
                self._cell.supervisor.latch.update(alarms)

    def _await_rest(self) -> None:
        """Watch the arms until they stand; a run that does not wait for a reset then ends."""
        self._reports = self._stops.await_rest()
        self._fire(STOPPED)
        if self.state is RunState.ENDED:
            self._finish()

    def _finish(self) -> None:
        """Give the arms back and keep how it went."""
        with _logged("the watchdog was not told of the end"):
            self._cell.watchdog.end()
        if self._channel is not None:
            with _logged("the operator channel was not closed"):
                self._channel.close()
        for role, lease in self._leases.items():
            with _logged(f"{role} was not given back"):
                self._arms[role].release(lease)
        self._final = self._result()
        with _logged("the last images were not written"):
            self._record.close()
        self._record.event("end", self._final.reason, to=self._final.outcome.value)

    def _result(self) -> RunResult:
        cell = self._cell
        stop = next((r for r in reversed(self._machine.records) if r.target == _STOPPING), None)
        error = self._error or self._record.error
        if (trip := cell.supervisor.latch.first_cause) is not None:
            outcome, reason = Outcome.TRIPPED, f"{trip.interlock}: {trip.subject}: {trip.reason}"
            if error is not None:
                reason += f"; error: {error}"
        elif error is not None:
            outcome, reason = Outcome.ERROR, str(error)
        elif stop is not None and stop.event == FINISHED:
            outcome, reason = self._task_outcome(cell.task)
        else:
            outcome, reason = Outcome.STOPPED, "" if stop is None else self._why(stop)
        return RunResult(
            outcome,
            reason,
            self._task_state(),
            (cell.clock.now_ns() - self._start_ns) * 1e-9,
            self._cycles,
            self._times,
            error,
            cell.supervisor.latch.causes,
            self._reports,
            () if self._reset is None else tuple(self._reset.resets),
            rests_on=self._rests_on(cell.task) if outcome is Outcome.DONE else (),
            lost=outcome in (Outcome.TRIPPED, Outcome.ERROR) and (self._lost or cell.watchdog.lost),
        )

    def _task_outcome(self, task: Task) -> tuple[Outcome, str]:
        """What a task that has finished says of itself."""
        try:
            outcome = _OUTCOMES.get(task.state, Outcome.DONE if task.succeeded else Outcome.FAILED)
            return outcome, _reason(task.transitions, outcome)
        except BaseException as error:
            return Outcome.ERROR, str(UnexpectedError(error))

    def _rests_on(self, task: Task) -> tuple[str, ...]:
        if not isinstance(task, Conditional):
            return ()
        try:
            return tuple(str(each) for each in task.rests_on)
        except Exception as error:
            return (f"its assumptions hold, which it failed to name: {UnexpectedError(error)}",)

    def _task_state(self) -> str:
        try:
            return self._cell.task.state
        except BaseException:
            return "unknown"

    def _why(self, stop: TransitionRecord) -> str:
        if stop.event == TIMEOUT and stop.source == _RUNNING:
            return f"longer than max_duration_s: {self._cell.max_duration_s:g}"
        return stop.reason

    def _fire(self, event: str, reason: str = "") -> None:
        self._machine.fire(event, reason, now_ns=self._cell.clock.now_ns())

    def _alarms(self) -> Sequence[Violation]:
        return self._cell.watchdog.alarms(self._cell.clock.now_ns())

    def _require_channel(self) -> OperatorChannel:
        assert self._channel is not None
        return self._channel


@contextmanager
def _logged(what: str) -> Iterator[None]:
    """Log what is raised inside and do the next thing: nothing keeps a run from its end."""
    try:
        yield
    except DeviceError as error:
        logger.warning("%s: %s", what, error)
    except BaseException:
        logger.exception(what)


_RUNNING, _STOPPING, _WAITING = map(state_name, (RunState.RUNNING, RunState.STOPPING, RunState.WAITING_FOR_RESET))
_OUTCOMES = {"stopped": Outcome.STOPPED, "tripped": Outcome.TRIPPED, "faulted": Outcome.ERROR}


def _has_waited(records: Sequence[TransitionRecord]) -> bool:
    """Whether the run has waited for a reset since its task was last at work."""
    last = next((r for r in reversed(records) if r.target in (_RUNNING, _WAITING)), None)
    return last is not None and last.target == _WAITING


def _reason(transitions: Sequence[TransitionRecord], outcome: Outcome) -> str:
    """Why a task ended as it did: its latest transition that has a reason, unless it is simply done."""
    if outcome is Outcome.DONE:
        return transitions[-1].reason if transitions else ""
    return next((f"{record.event}: {record.reason}" for record in reversed(transitions) if record.reason), "")
