"""The control cycle: read the arms, perceive, let the task think, let the supervisor judge, send, record.

One thread. Whatever goes wrong, the arms are told to stop before anything else happens, and the run ends in a report.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from cell.compose import Cell, Sensor
from cell.messages import command_message, contact_message, tcp_message
from cell.recording import Recorder
from control.view import ArmView, CellView, SensorView
from drivers.arm import Arm
from drivers.commands import Sent, TwistCommand
from drivers.errors import DeviceError
from drivers.lease import Lease
from drivers.samples import Stamped, TcpState
from geometry import se3
from geometry.errors import TouchcellError
from perception.estimate import ContactEstimate
from tasks.interface import Action, Observation, TransitionRecord

_REST_DEADLINE_NS = 2_000_000_000


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


@dataclass(slots=True)
class CycleTimes:
    """Durations of the stages of every cycle, nanoseconds, for the latency budget."""

    rows: dict[str, list[int]] = field(default_factory=dict)

    def add(self, stage: str, duration_ns: int) -> None:
        """Append one duration."""
        self.rows.setdefault(stage, []).append(duration_ns)


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
    """

    outcome: Outcome
    reason: str
    state: str
    duration_s: float
    cycles: int
    times: CycleTimes
    error: TouchcellError | None = None


class StopRequest:
    """Set by a signal handler or a key; the first asks for an orderly end, the second for a stop at once."""

    def __init__(self) -> None:
        self.count = 0

    def ask(self) -> None:
        """Ask once more."""
        self.count += 1


class RunLoop:
    """Runs a composed cell's task to its end.

    Args:
        cell: built and activated.
        recorder: where everything goes; None records nothing.
        stop: looked at in every cycle.
        on_cycle: called after every cycle, for a live display.
    """

    def __init__(
        self,
        cell: Cell,
        recorder: Recorder | None,
        *,
        stop: StopRequest | None = None,
        on_cycle: Callable[[Progress], None] | None = None,
    ) -> None:
        self._cell = cell
        self._recorder = recorder
        self._stop = stop or StopRequest()
        self._on_cycle = on_cycle
        self._times = CycleTimes()
        self._transitions_written = 0

    def run(self) -> RunResult:
        """Run until the task has finished, the supervisor has tripped, or something has failed. Never raises for what
        devices, data or disk do: that ends in a result, with the arms told to stop."""
        cell = self._cell
        start_ns = cell.clock.now_ns()
        period_ns = round(1e9 / cell.rate_hz)
        leases: dict[str, Lease] = {}
        cycles = 0
        error: TouchcellError | None = None
        reason = ""
        try:
            for role, arm in cell.arms.items():
                if isinstance(arm, Arm):
                    leases[role] = arm.acquire(cell.task_name)
            while not cell.task.finished:
                now_ns = cell.clock.now_ns()
                if now_ns - start_ns > cell.max_duration_s * 1e9:
                    reason = f"longer than max_duration_s: {cell.max_duration_s:g}"
                    break
                if self._stop.count > 1:
                    reason = "stopped at once by the operator"
                    break
                self._cycle(now_ns, leases)
                cycles += 1
                cell.clock.sleep_until_ns(start_ns + cycles * period_ns)
        except TouchcellError as caught:
            error = caught
            reason = str(caught)
        finally:
            self._stop_arms()
            self._watch_until_rest()
            for role, lease in leases.items():
                cell.arms[role].release(lease)
        if (trip := cell.supervisor.latch.first_cause) is not None:
            outcome, reason = Outcome.TRIPPED, f"{trip.interlock}: {trip.subject}: {trip.reason}"
        elif error is not None:
            outcome = Outcome.ERROR
        elif cell.task.finished:
            outcome = _OUTCOMES.get(cell.task.state, Outcome.DONE if cell.task.succeeded else Outcome.FAILED)
            reason = reason or _last_reason(cell.task.transitions)
        else:
            outcome = Outcome.STOPPED
        duration_s = (cell.clock.now_ns() - start_ns) * 1e-9
        self._record_end(outcome, reason)
        return RunResult(outcome, reason, cell.task.state, duration_s, cycles, self._times, error)

    def _cycle(self, now_ns: int, leases: Mapping[str, Lease]) -> None:
        cell = self._cell
        started = time.perf_counter_ns()
        states = {role: arm.tcp() for role, arm in cell.arms.items()}
        contacts = {}
        for role, sensor in cell.sensors.items():
            if sensor.arm_role is not None:
                state = states[sensor.arm_role]
                sensor.source.record_pose(state.t_ns, se3.compose(state.value.T_base_tcp, sensor.T_tcp_sensor))
            if (estimate := sensor.source.update(now_ns)) is not None:
                contacts[role] = estimate
        perceived = time.perf_counter_ns()
        ended = bool(cell.sensors) and all(sensor.source.ended for sensor in cell.sensors.values())
        observation = Observation(now_ns, states, contacts, operator_stop=self._stop.count > 0, ended=ended)
        action = cell.task.tick(observation)
        thought = time.perf_counter_ns()
        verdict = cell.supervisor.review(_view(now_ns, states, contacts, action))
        judged = time.perf_counter_ns()
        sent: dict[str, Sent[TwistCommand]] = {}
        if verdict.allow:
            for role, command in action.twists.items():
                sent[role] = cell.arms[role].send_twist(command, leases[role])
            for role in leases.keys() - action.twists.keys():
                cell.arms[role].stop()
        else:
            self._stop_arms()
            if verdict.trip is not None:
                cell.task.trip(now_ns, str(verdict.trip))
        done = time.perf_counter_ns()
        self._count("sense", perceived - started)
        self._count("task and control", thought - perceived)
        self._count("supervisor", judged - thought)
        self._count("gate and send", done - judged)
        self._count("cycle", done - started)
        for sensor in cell.sensors.values():
            self._count_stages(sensor)
        self._record(now_ns, states, contacts, action, sent)
        self._count("record", time.perf_counter_ns() - done)
        if self._on_cycle is not None:
            self._on_cycle(Progress((now_ns - cell.start_ns) * 1e-9, cell.task.state, contacts, action.telemetry))

    def _watch_until_rest(self) -> None:
        """Record the arms until they stand, so that the stopping distance is on file; then they are let go of."""
        cell = self._cell
        deadline_ns = cell.clock.now_ns() + _REST_DEADLINE_NS
        try:
            while cell.clock.now_ns() < deadline_ns and not all(
                arm.at_rest() for arm in cell.arms.values() if isinstance(arm, Arm)
            ):
                cell.clock.sleep_until_ns(cell.clock.now_ns() + round(1e9 / cell.rate_hz))
                for role, arm in cell.arms.items():
                    state = arm.tcp()
                    self._write(f"/arms/{role}/tcp", state.t_ns, tcp_message(state))
        except TouchcellError as error:
            self._write("/events", cell.clock.now_ns(), {"event": "lost sight while stopping", "reason": str(error)})

    def _stop_arms(self) -> None:
        for arm in self._cell.arms.values():
            if isinstance(arm, Arm):
                try:
                    arm.stop()
                except DeviceError as error:
                    # Every other arm must still be told; the device's own fault tells the story.
                    self._write("/events", self._cell.clock.now_ns(), {"event": "stop failed", "reason": str(error)})

    def _count(self, stage: str, duration_ns: int) -> None:
        self._times.add(stage, duration_ns)

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
    ) -> None:
        if self._recorder is None:
            return
        cell = self._cell
        for role, state in states.items():
            self._write(f"/arms/{role}/tcp", state.t_ns, tcp_message(state))
        for role, estimate in contacts.items():
            self._write(f"/sensors/{role}/contact", now_ns, contact_message(estimate))
        for role, sensor in cell.sensors.items():
            for topic, t_ns, message in sensor.extra_messages(now_ns):
                self._write(f"/sensors/{role}/{topic}", t_ns, message)
        for role, command in sent.items():
            self._write(f"/arms/{role}/command", command.t_ns, command_message(command))
        self._write("/task", now_ns, {"state": cell.task.state, **action.telemetry})
        for record in cell.task.transitions[self._transitions_written :]:
            self._write(
                "/events",
                record.t_ns,
                {"event": record.event, "from": record.source, "to": record.target, "reason": record.reason},
            )
            self._transitions_written += 1

    def _record_end(self, outcome: Outcome, reason: str) -> None:
        self._write("/events", self._cell.clock.now_ns(), {"event": "end", "to": outcome.value, "reason": reason})

    def _write(self, topic: str, t_ns: int, message: Mapping[str, Any]) -> None:
        if self._recorder is not None and not self._recorder.failed:
            self._recorder.write(topic, t_ns, message)


_OUTCOMES = {"stopped": Outcome.STOPPED, "tripped": Outcome.TRIPPED, "faulted": Outcome.ERROR}


def _view(
    now_ns: int,
    states: Mapping[str, Stamped[TcpState]],
    contacts: Mapping[str, ContactEstimate],
    action: Action,
) -> CellView:
    return CellView(
        now_ns,
        {role: ArmView(state, action.twists.get(role)) for role, state in states.items()},
        {role: _sensor_view(estimate) for role, estimate in contacts.items()},
    )


def _sensor_view(estimate: ContactEstimate) -> SensorView:
    depth_m = sigma_m = None
    if estimate.belief is not None:
        depth_m = float(se3.inverse(estimate.belief.mean)[2, 3])
        sigma_m = float(np.sqrt(estimate.belief.covariance[2, 2]))
    return SensorView(
        estimate.t_frame_ns,
        estimate.seq,
        estimate.in_contact,
        depth_m,
        estimate.in_range,
        estimate.nis,
        sigma_m,
    )


def _last_reason(transitions: Sequence[TransitionRecord]) -> str:
    return transitions[-1].reason if transitions else ""
