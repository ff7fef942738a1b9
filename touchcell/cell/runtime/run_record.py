"""What a run loop records: each cycle and each event, into the recording and the black box, and labelled frames."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, Protocol

from touchcell.cell.errors import RecordingError, UnexpectedError
from touchcell.cell.recording.mcap import Recorder, encode
from touchcell.cell.recording.messages import (
    command_message,
    contact_message,
    pose_message,
    tcp_message,
    verdict_message,
)
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.observer import Reading
from touchcell.cell.runtime.timing import CycleTimes
from touchcell.control.supervisor import Verdict
from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import TouchcellError
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Action

logger = logging.getLogger(__name__)


class Box(Protocol):
    """Something that keeps messages and never fails; see ``touchcell.cell.runtime.black_box``."""

    def add(self, topic: str, t_ns: int, data: bytes) -> None:
        """Keep one message, encoded as for the recording."""
        ...


class RunRecord:
    """Where a run is recorded. Failures are kept in ``error`` and raised nowhere: arms are watched without a recording.

    Args:
        cell: that runs.
        recorder: the recording; None records nothing.
        box: keeps the latest messages in memory.
    """

    def __init__(self, cell: Cell, recorder: Recorder | None, box: Box | None) -> None:
        self._cell = cell
        self._recorder = recorder
        self._box = box
        self._transitions_written = 0
        self.error: TouchcellError | None = None

    def begin(self) -> None:
        """Note what recorded images need to be understood."""
        for role, sensor in self._cell.sensors.items():
            if (about := sensor.about()) is not None:
                self.write(f"/sensors/{role}/preprocessing", self._cell.clock.now_ns(), about)

    def new_task(self) -> None:
        """The cell has a new task, whose transitions are recorded from the first one."""
        self._transitions_written = 0

    def event(self, event: str, reason: str, **more: str) -> None:
        """Record that something happened now."""
        self.write("/events", self._cell.clock.now_ns(), {"event": event, **more, "reason": reason})

    def state(self, role: str, state: Stamped[TcpState]) -> None:
        """Record one arm on its way to rest."""
        try:
            message = tcp_message(state)
        except Exception as error:
            # What cannot be recorded does not keep an arm from being watched.
            self.event("no pose", f"{role}: {error}")
        else:
            self.write(f"/arms/{role}/tcp", state.t_ns, message)

    def cycle(
        self,
        reading: Reading,
        action: Action,
        sent: Mapping[str, Sent[TwistCommand]],
        verdict: Verdict,
        times: CycleTimes,
    ) -> None:
        """Record everything about one control cycle."""
        if self._recorder is None and self._box is None:
            return
        cell, now_ns = self._cell, reading.now_ns
        for role, state in reading.states.items():
            self.write(f"/arms/{role}/tcp", state.t_ns, tcp_message(state))
        for role, estimate in reading.contacts.items():
            self.write(f"/sensors/{role}/contact", now_ns, contact_message(estimate))
        for role, sensor in cell.sensors.items():
            for topic, t_ns, message in sensor.extra_messages(now_ns):
                self.write(f"/sensors/{role}/{topic}", t_ns, message, boxed=topic != "image")
        for name, health in reading.health.items():
            self.write(f"/health/{name}", health.t_ns, {"seq": health.seq, **health.value})
        for role, sample in reading.devices.items():
            self.write(f"/devices/{role}/reading", sample.t_ns, {"seq": sample.seq, **sample.value})
        if verdict.allow:
            for role, setting in action.settings.items():
                self.write(f"/devices/{role}/setting", now_ns, setting)
        if cell.scene is not None:
            objects = cell.scene.objects()
            for name, T_world_object in objects.value.items():
                self.write(f"/objects/{name}", objects.t_ns, pose_message(T_world_object))
        for role, command in sent.items():
            self.write(f"/arms/{role}/command", command.t_ns, command_message(command))
        if verdict.violations or not verdict.allow:
            self.write("/safety", now_ns, verdict_message(verdict))
        self.write("/task", now_ns, {"state": cell.task.state, **action.telemetry})
        self.write("/timing", now_ns, times.message())
        for record in cell.task.transitions[self._transitions_written :]:
            self.write(
                "/events",
                record.t_ns,
                {"event": record.event, "from": record.source, "to": record.target, "reason": record.reason},
            )
            self._transitions_written += 1

    def keep_frames(self, contacts: Mapping[str, ContactEstimate], action: Action) -> None:
        """Keep every frame that the task has labelled, and once what a sensor sees while it touches nothing."""
        collection = self._cell.collection
        if collection is None:
            return
        for role in contacts:
            frame = self._cell.sensors[role].frame
            if frame is not None and not contacts[role].in_contact:
                collection.keep_rest(frame.value.image)
        for role, T_f_s in action.labels.items():
            frame = self._cell.sensors[role].frame
            if frame is not None:
                collection.keep(frame.value.image, T_f_s)

    def write(self, topic: str, t_ns: int, message: Mapping[str, Any], *, boxed: bool = True) -> None:
        """Record one message, in the black box only if ``boxed``."""
        boxed = boxed and self._box is not None
        if not boxed and self._recorder is None:
            return
        try:
            data = encode(message)
        except Exception as error:
            # A value of a plug-in's that is no JSON; the rest of the run is recorded.
            logger.exception("a message of %s is left out", topic)
            self.error = self.error or UnexpectedError(error)
            return
        if boxed and self._box is not None:
            try:
                self._box.add(topic, t_ns, data)
            except Exception:
                logger.exception("the black box failed and takes no more messages")
                self._box = None
        if self._recorder is None:
            return
        try:
            self._recorder.write_encoded(topic, t_ns, data)
        except RecordingError as error:
            self._give_up(error)
        except Exception as error:
            self._give_up(UnexpectedError(error))

    def _give_up(self, error: TouchcellError) -> None:
        logger.error("recording ends: %s", error)
        self._recorder = None
        self.error = error
