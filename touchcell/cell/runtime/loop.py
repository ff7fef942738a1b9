"""The control cycle: read the arms, perceive, let the task think, let the supervisor judge, send, record.

One thread. Whatever goes wrong, all arms are told to stop before anything else happens, each is watched until it
stands, and the run ends in a report, or waits for a person if its cell file says so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Protocol, cast

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.dataset_writer import Collection
from touchcell.cell.recording.mcap import Recorder, encode
from touchcell.cell.recording.messages import (
    command_message,
    contact_message,
    pose_message,
    tcp_message,
    verdict_message,
)
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.reset_procedure import ResetProcedure
from touchcell.cell.runtime.sensor import Sensor
from touchcell.cell.runtime.stopping import Stopper, StopReport
from touchcell.cell.runtime.timing import CycleTimes
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import ResetDone
from touchcell.control.supervisor import Verdict
from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import ServoArm, TwistSink
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.errors import TouchcellError
from touchcell.geometry import se3
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Action, Observation, TransitionRecord


class Outcome(Enum):
    """How a run ended."""

    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Progress:
    """What a live display may show after a cycle."""

    t_s: float
    state: str
    contacts: Mapping[str, ContactEstimate]
    telemetry: Mapping[str, float]
    waiting: str = ""
    """What a person has to know while the run waits for a reset; empty while it goes on."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended and how long its cycles took.

    Attributes:
        outcome: in one word.
        reason: in one sentence; empty when the task simply finished.
        state: the task's last state.
        duration_s: cell time from start to end.
        cycles: control cycles.
        times: duration of each stage of each cycle.
        error: what was raised, where something was.
        causes: what the supervisor latched, the first cause first.
        stops: how each arm came to rest.
        resets: what was cleared on the way, and by whom, where the run waited for that.
    """

    outcome: Outcome
    reason: str
    state: str
    duration_s: float
    cycles: int
    times: CycleTimes
    error: TouchcellError | None = None
    causes: tuple[Violation, ...] = ()
    stops: Mapping[str, StopReport] = field(default_factory=dict)
    resets: tuple[ResetDone, ...] = ()


class StopRequest:
    """Set by a signal handler or a key. The first asks for an orderly end, the second for a stop at once."""

    def __init__(self) -> None:
        self.count = 0

    def ask(self) -> None:
        """Ask once more."""
        self.count += 1

    def ask_at_once(self) -> None:
        """Ask for a stop at once."""
        self.count += 2


class Box(Protocol):
    """Something that keeps messages and never fails; see ``touchcell.cell.runtime.black_box``."""

    def add(self, topic: str, t_ns: int, data: bytes) -> None:
        """Keep one message, encoded as for the recording."""
        ...


class RunLoop:
    """Runs a composed cell's task to its end: ``run``, or ``begin``, ``step`` while it returns True, and ``end``.

    Args:
        cell: built and activated.
        recorder: where everything goes; None records nothing.
        box: what keeps the latest messages in memory.
        stop: looked at in every cycle.
        on_cycle: called after every cycle, for a live display.
        desk: where a person may reset a run that has tripped; without one it ends, whatever the cell file says.
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
        desk: OperatorChannel | None = None,
        on_trip: Callable[[RunResult], None] | None = None,
    ) -> None:
        self._cell = cell
        self._recorder = recorder
        self._box = box
        self._stop = stop or StopRequest()
        self._on_cycle = on_cycle
        self._times = CycleTimes()
        self._transitions_written = 0
        self._arms = {role: cast(ServoArm, arm) for role, arm in cell.arms.items() if isinstance(arm, TwistSink)}
        self._stopper = Stopper(self._arms, cell.stop_categories, cell.clock, 1.0 / cell.rate_hz, cell.holding)
        self._leases: dict[str, Lease] = {}
        self._sent: Mapping[str, Sent[TwistCommand]] = {}
        self._desk = desk if cell.plan.cell.on_trip == "wait_for_reset" else None
        self._on_trip = on_trip
        self._waiting: ResetProcedure | None = None
        self._resets: tuple[ResetDone, ...] = ()
        self._waited_from_ns = self._waited_ns = 0
        self._start_ns = self._due_ns = cell.clock.now_ns()
        self._cycles = 0
        self._reason = ""
        self._error: TouchcellError | None = None
        self._ending = False

    def run(self) -> RunResult:
        """Run until the task has finished, the supervisor has tripped, or something has failed. Never raises for what
        devices, data or disk do: that ends in a result, with the arms told to stop."""
        try:
            self.begin()
            while self.step():
                pass
        finally:
            result = self.end()
        return result

    @property
    def has_waited(self) -> bool:
        """Whether the latest trip has been told to ``on_trip``."""
        return self._waiting is not None

    def begin(self) -> None:
        """Wait for each camera's first frame, take the arms' leases, and be watched from now on."""
        try:
            for role, sensor in self._cell.sensors.items():
                sensor.await_frame()
                if (about := sensor.about()) is not None:
                    self._write(f"/sensors/{role}/preprocessing", self._cell.clock.now_ns(), about)
            for role, arm in self._arms.items():
                self._leases[role] = arm.acquire(self._cell.task_name)
            if self._cell.scene is not None:
                # In real time it has to catch up with all that happened since it was made.
                self._cell.scene.objects()
            self._cell.watchdog.begin()
        except TouchcellError as error:
            self._error = error
        self._start_ns = self._due_ns = self._cell.clock.now_ns()

    def step(self) -> bool:
        """One cycle, and the wait for the next; returns whether there is to be one."""
        cell = self._cell
        if self._waiting is not None:
            going = self._wait(self._waiting)
        elif self._error is not None or cell.task.finished:
            return False
        else:
            going = self._work()
        if going:
            self._due_ns += round(1e9 / cell.rate_hz)
            cell.clock.sleep_until_ns(self._due_ns)
        return going

    def _work(self) -> bool:
        cell = self._cell
        now_ns = cell.clock.now_ns()
        if now_ns - self._start_ns - self._waited_ns > cell.max_duration_s * 1e9:
            self._reason = f"longer than max_duration_s: {cell.max_duration_s:g}"
            return False
        if self._stop.count > 1:
            self._reason = "stopped at once by the operator"
            return False
        try:
            cell.watchdog.beat()
            self._cycle()
        except DeviceError as error:
            if self._desk is None:
                self._error = error
                return False
            self._distrust(error)
        except TouchcellError as error:
            self._error = error
            return False
        self._cycles += 1
        if cell.supervisor.latch.first_cause is not None and cell.task.finished and self._desk is not None:
            self._begin_waiting(self._desk)
            return True
        return not cell.task.finished

    def _distrust(self, error: DeviceError) -> None:
        """Latch what a device has raised: a run that waits gets over it like over any other fault."""
        cell = self._cell
        roles = {arm.name: role for role, arm in cell.arms.items()}
        now_ns, latch = cell.clock.now_ns(), cell.supervisor.latch
        # Whoever looks on from outside may know better why a device does not answer.
        latch.update(cell.watchdog.alarms(now_ns))
        fault = Violation("device", Severity.FAULT, roles.get(error.device, error.device), str(error), now_ns)
        is_new = (fault.interlock, fault.subject) not in {(cause.interlock, cause.subject) for cause in latch.causes}
        latch.update([fault])
        if not cell.task.finished:
            cell.task.trip(now_ns, str(error))
        if is_new:
            self._stop_arms(tripped=True)
            self._come_to_rest()

    def _begin_waiting(self, desk: OperatorChannel) -> None:
        self._waited_from_ns = self._cell.clock.now_ns()
        stops = self._come_to_rest()
        # A black box takes longer to write than a watchdog waits. Arms that nobody guards obey no motion.
        self._cell.watchdog.end()
        self._waiting = ResetProcedure(self._cell, self._leases, desk)
        desk.open()
        self._due_ns = self._cell.clock.now_ns()
        self._event("waiting", "for a reset")
        if self._on_trip is not None:
            self._on_trip(self._result(stops))

    def _wait(self, waiting: ResetProcedure) -> bool:
        """One cycle of a run that has tripped: the arms stand and are watched, and people are answered."""
        cell = self._cell
        if self._stop.count:
            self._reason = "ended by the operator after a trip"
            return False
        view = None
        try:
            states, contacts, now_ns = self._look()
            view = replace(self._view(now_ns, states, contacts, Action()), at_work=False)
            cell.supervisor.review(view, cell.watchdog.alarms(now_ns))
            if not all(arm.at_rest() for arm in self._arms.values()):
                self._stop_arms(tripped=True)
                self._come_to_rest()
                self._due_ns = cell.clock.now_ns()
        except DeviceError as error:
            self._distrust(error)
        going_on, done = waiting.answer(view)
        for words in done:
            self._event("operator", words)
        self._resets += tuple(waiting.resets)
        waiting.resets.clear()
        if going_on:
            self._restart()
        if self._on_cycle is not None:
            words = "" if going_on else waiting.words
            t_s = (cell.clock.now_ns() - cell.start_ns) * 1e-9
            self._on_cycle(Progress(t_s, cell.task.state, {}, {}, words))
        return True

    def _restart(self) -> None:
        """The task begins anew, from its first state."""
        cell = self._cell
        cell.task = cell.new_task()
        self._transitions_written = 0
        self._sent = {}
        self._waiting = None
        if self._desk is not None:
            self._desk.close()
        self._due_ns = cell.clock.now_ns()
        self._waited_ns += self._due_ns - self._waited_from_ns

    def end(self) -> RunResult:
        """Bring the arms to rest, give them back, and say how it went."""
        cell = self._cell
        self._ending = True
        # Whoever looks on from outside may know better why a device does not answer.
        if self._error is not None and (alarms := cell.watchdog.alarms(cell.clock.now_ns())):
            cell.supervisor.latch.update(alarms)
        self._stop_arms(tripped=self._error is not None or cell.supervisor.latch.first_cause is not None)
        stops = self._come_to_rest()
        cell.watchdog.end()
        if self._desk is not None:
            self._desk.close()
        for role, lease in self._leases.items():
            # What an arm that is gone says to it has been told already.
            with suppress(DeviceError):
                self._arms[role].release(lease)
        result = self._result(stops)
        self._write(
            "/events", cell.clock.now_ns(), {"event": "end", "to": result.outcome.value, "reason": result.reason}
        )
        return result

    def _come_to_rest(self) -> Mapping[str, StopReport]:
        """Watch the arms that were told to stop until they stand."""
        stops = self._stopper.watch(self._record_state, self._escalated)
        for role, report in stops.items():
            if report.problem:
                self._event("stop failed", f"{role}: {report.problem}")
        return stops

    def _result(self, stops: Mapping[str, StopReport]) -> RunResult:
        """How it stands now."""
        cell = self._cell
        reason = self._reason or ("" if self._error is None else str(self._error))
        if (trip := cell.supervisor.latch.first_cause) is not None:
            outcome, reason = Outcome.TRIPPED, f"{trip.interlock}: {trip.subject}: {trip.reason}"
        elif self._error is not None:
            outcome = Outcome.ERROR
        elif cell.task.finished and self._waiting is None:
            outcome = _OUTCOMES.get(cell.task.state, Outcome.DONE if cell.task.succeeded else Outcome.FAILED)
            reason = reason or _last_reason(cell.task.transitions)
        else:
            outcome = Outcome.STOPPED
        return RunResult(
            outcome,
            reason,
            cell.task.state,
            (cell.clock.now_ns() - self._start_ns) * 1e-9,
            self._cycles,
            self._times,
            self._error,
            cell.supervisor.latch.causes,
            stops,
            self._resets,
        )

    def _cycle(self) -> None:
        cell = self._cell
        started = time.perf_counter_ns()
        states, contacts, now_ns = self._look()
        perceived = time.perf_counter_ns()
        ended = bool(cell.sensors) and all(sensor.source.ended for sensor in cell.sensors.values())
        observation = Observation(now_ns, states, contacts, operator_stop=self._stop.count > 0, ended=ended)
        action = cell.task.tick(observation)
        thought = time.perf_counter_ns()
        verdict = cell.supervisor.review(self._view(now_ns, states, contacts, action), cell.watchdog.alarms(now_ns))
        judged = time.perf_counter_ns()
        sent: dict[str, Sent[TwistCommand]] = {}
        if verdict.allow:
            for role, command in action.twists.items():
                # A violation that only limits slows everything down, in the direction that it has.
                slowed = command if verdict.speed == 1.0 else replace(command, twist=verdict.speed * command.twist)
                sent[role] = cell.arms[role].send_twist(slowed, self._leases[role])
            for role in self._leases.keys() - action.twists.keys():
                cell.arms[role].stop()
        else:
            self._stop_arms(tripped=True)
            if verdict.trip is not None:
                cell.task.trip(now_ns, str(verdict.trip))
        self._sent = sent
        if cell.collection is not None:
            self._keep(cell.collection, contacts, action.labels)
        done = time.perf_counter_ns()
        for sensor in cell.sensors.values():
            self._count_stages(sensor)
        self._times.add("sense", perceived - started)
        self._times.add("task and control", thought - perceived)
        self._times.add("supervisor", judged - thought)
        self._times.add("gate and send", done - judged)
        self._times.add("cycle", done - started)
        self._record(now_ns, states, contacts, action, sent, verdict)
        self._times.add("record", time.perf_counter_ns() - done)
        if self._on_cycle is not None:
            self._on_cycle(Progress((now_ns - cell.start_ns) * 1e-9, cell.task.state, contacts, action.telemetry))

    def _look(self) -> tuple[dict[str, Stamped[TcpState]], dict[str, ContactEstimate], int]:
        """Read the arms and perceive; returns states, contacts and the time that they are for."""
        cell = self._cell
        self._times.begin()
        started = time.perf_counter_ns()
        states = {role: arm.tcp() for role, arm in cell.arms.items()}
        self._times.add("read arms", time.perf_counter_ns() - started)
        contacts = {}
        for role, sensor in cell.sensors.items():
            if sensor.arm_role is not None:
                state = states[sensor.arm_role]
                # A pose that is not finite is for the supervisor to see, not for the filter.
                if all_finite(state.value.T_base_tcp):
                    T_base_sensor = se3.compose(state.value.T_base_tcp, sensor.T_tcp_sensor)
                    sensor.source.record_pose(state.t_ns, T_base_sensor)
            if (estimate := sensor.source.update(cell.clock.now_ns())) is not None:
                contacts[role] = estimate
        # Only now: what a device's own thread brought in the meantime would seem to come from the future.
        now_ns = cell.clock.now_ns()
        return states, contacts, now_ns

    def _keep(
        self, collection: Collection, contacts: Mapping[str, ContactEstimate], labels: Mapping[str, Array]
    ) -> None:
        """What a sensor sees while it touches nothing, once, and every frame that the task has labelled."""
        for role in contacts:
            frame = self._cell.sensors[role].frame
            if frame is not None and not contacts[role].in_contact:
                collection.keep_rest(frame.value.image)
        for role, T_f_s in labels.items():
            frame = self._cell.sensors[role].frame
            if frame is not None:
                collection.keep(frame.value.image, T_f_s)

    def _stop_arms(self, *, tripped: bool) -> None:
        """Tell all arms to stop: as the cell file says when something is wrong, else holding where they are."""
        distrusted = {c.subject for c in self._cell.supervisor.latch.causes if c.severity is Severity.FAULT}
        failed = self._stopper.stop(tripped=tripped, distrusted=distrusted)
        for role, error in failed.items():
            self._event("stop failed", f"{role}: {error}")

    def _escalated(self, role: str, report: StopReport, waited_s: float) -> None:
        reason = f"not seen at rest {waited_s:.3f} s after a stop by category {int(report.category)}"
        now_ns = self._cell.clock.now_ns()
        self._cell.supervisor.latch.update(
            [Violation("stop", Severity.FAULT, role, reason, now_ns, value=waited_s, limit=report.declared_s, unit="s")]
        )
        self._event("escalated", f"{role}: {reason}")

    def _record_state(self, role: str, state: Stamped[TcpState]) -> None:
        # Arms on their way to rest are still guarded.
        self._cell.watchdog.beat()
        try:
            message = tcp_message(state)
        except TouchcellError as error:
            # What cannot be put on file does not keep an arm from being watched.
            self._event("no pose", f"{role}: {error}")
        else:
            self._write(f"/arms/{role}/tcp", state.t_ns, message)

    def _event(self, event: str, reason: str) -> None:
        self._write("/events", self._cell.clock.now_ns(), {"event": event, "reason": reason})

    def _view(
        self,
        now_ns: int,
        states: Mapping[str, Stamped[TcpState]],
        contacts: Mapping[str, ContactEstimate],
        action: Action,
    ) -> CellView:
        return CellView(
            now_ns,
            {
                role: ArmView(state, action.twists.get(role), self._sent.get(role), self._joints(role))
                for role, state in states.items()
            },
            {role: _sensor_view(estimate, self._cell.sensors[role]) for role, estimate in contacts.items()},
            self._cell.task.state,
        )

    def _joints(self, role: str) -> Stamped[JointState] | None:
        cell = self._cell
        return cell.arms[role].joints() if role in cell.watched_joints else None

    def _count_stages(self, sensor: Sensor) -> None:
        for stage, duration_ns in sensor.stage_times().items():
            if duration_ns:
                self._times.add(stage, duration_ns)

    def _record(
        self,
        now_ns: int,
        states: Mapping[str, Stamped[TcpState]],
        contacts: Mapping[str, ContactEstimate],
        action: Action,
        sent: Mapping[str, Sent[TwistCommand]],
        verdict: Verdict,
    ) -> None:
        if self._recorder is None and self._box is None:
            return
        cell = self._cell
        for role, state in states.items():
            self._write(f"/arms/{role}/tcp", state.t_ns, tcp_message(state))
        for role, estimate in contacts.items():
            self._write(f"/sensors/{role}/contact", now_ns, contact_message(estimate))
        for role, sensor in cell.sensors.items():
            for topic, t_ns, message in sensor.extra_messages(now_ns):
                self._write(f"/sensors/{role}/{topic}", t_ns, message, boxed=topic != "image")
        if cell.scene is not None:
            objects = cell.scene.objects()
            for name, T_world_object in objects.value.items():
                self._write(f"/objects/{name}", objects.t_ns, pose_message(T_world_object))
        for role, command in sent.items():
            self._write(f"/arms/{role}/command", command.t_ns, command_message(command))
        if verdict.violations or not verdict.allow:
            self._write("/safety", now_ns, verdict_message(verdict))
        self._write("/task", now_ns, {"state": cell.task.state, **action.telemetry})
        self._write("/timing", now_ns, self._times.message())
        for record in cell.task.transitions[self._transitions_written :]:
            self._write(
                "/events",
                record.t_ns,
                {"event": record.event, "from": record.source, "to": record.target, "reason": record.reason},
            )
            self._transitions_written += 1

    def _write(self, topic: str, t_ns: int, message: Mapping[str, Any], *, boxed: bool = True) -> None:
        boxed = boxed and self._box is not None
        recorded = self._recorder is not None and not self._recorder.failed
        if not boxed and not recorded:
            return
        data = encode(message)
        if boxed and self._box is not None:
            self._box.add(topic, t_ns, data)
        if self._recorder is None or not recorded:
            return
        try:
            self._recorder.write_encoded(topic, t_ns, data)
        except RecordingError as error:
            # Nothing keeps the arms from being watched until they stand.
            if not self._ending:
                raise
            self._error = self._error or error


_OUTCOMES = {"stopped": Outcome.STOPPED, "tripped": Outcome.TRIPPED, "faulted": Outcome.ERROR}


def _sensor_view(estimate: ContactEstimate, sensor: Sensor) -> SensorView:
    depth_m = sigma_m = shear_m = torsion_rad = None
    if estimate.belief is not None:
        T_f_s = se3.inverse(estimate.belief.mean)
        depth_m = float(T_f_s[2, 3])
        sigma_m = math.sqrt(estimate.belief.covariance[2, 2])
        shear_m = math.hypot(T_f_s[0, 3], T_f_s[1, 3])
        torsion_rad = math.atan2(T_f_s[1, 0], T_f_s[0, 0])
    content, brightness = sensor.picture()
    return SensorView(
        estimate.t_frame_ns,
        estimate.seq,
        estimate.in_contact,
        depth_m,
        estimate.in_range,
        estimate.nis,
        sigma_m,
        shear_m,
        torsion_rad,
        content,
        brightness,
        None if estimate.belief is None else estimate.belief.mean,
        estimate.markers,
        sensor.arm_role,
    )


def _last_reason(transitions: Sequence[TransitionRecord]) -> str:
    return transitions[-1].reason if transitions else ""
