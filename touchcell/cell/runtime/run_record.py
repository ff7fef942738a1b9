"""What a run loop records: each cycle and each event, into the recording and the black box, and labelled frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Protocol

from touchcell.cell.errors import RecordingError, UnexpectedError
from touchcell.cell.recording.frame_compressor import FrameCompressor
from touchcell.cell.recording.message_types import Encoded, Encoder
from touchcell.cell.recording.messages import (
    command_message,
    contact_message,
    declared_type,
    levels_message,
    pose_message,
    tcp_message,
    values_message,
    verdict_message,
)
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.recording.viewer_record import ViewerRecord
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.observer import Reading
from touchcell.cell.runtime.timing import CycleTimes
from touchcell.cell.scene.description import describe_scene
from touchcell.control.supervisor import Verdict
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.protocols import JointSource
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import TouchcellError
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Action

logger = logging.getLogger(__name__)

_EVENTS: Final = "/events"
_LEVELS_NS: Final = 100_000_000
"""Time between two looks at how near the interlocks are to their limits, which people watch."""


class Box(Protocol):
    """Something that keeps messages and never fails; see ``touchcell.cell.runtime.black_box``."""

    def add(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        """Keep topics, stamps and messages, encoded as for the recording."""
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
        self._encoder = recorder.encoder if recorder is not None else Encoder(declared_type)
        self._pending: list[tuple[str, int, Encoded]] = []
        self._transitions_written = 0
        self._zeros = 0
        self._levels_ns = -(1 << 62)
        self._viewers: ViewerRecord | None = None
        self._frames: FrameCompressor | None = None
        kind = cell.plan.cell.recording.frames
        if recorder is not None and kind != "none":
            self._frames = FrameCompressor(kind, complete=isinstance(cell.clock, VirtualClock))
        self._jointed: dict[str, JointSource] = {}
        if recorder is not None:
            self._for_viewers(recorder)
        self.error: TouchcellError | None = None

    def begin(self) -> None:
        """Note what recorded images need to be understood, and what the cell looks like."""
        if self._frames is not None:
            self._frames.start()
        if self._viewers is not None:
            self._view(partial(self._viewers.begin, self._cell.clock.now_ns()))
        for role, sensor in self._cell.sensors.items():
            if (about := sensor.about()) is not None:
                self.write(f"/sensors/{role}/preprocessing", self._cell.clock.now_ns(), about)

    def new_task(self) -> None:
        """The cell has a new task, whose transitions are recorded from the first one."""
        self._transitions_written = 0

    def event(self, event: str, reason: str, **more: str) -> None:
        """Record that something happened now."""
        self.write(_EVENTS, self._cell.clock.now_ns(), {"event": event, **more, "reason": reason})

    def state(self, role: str, state: Stamped[TcpState]) -> None:
        """Record one arm on its way to rest."""
        try:
            message = tcp_message(state)
        except BaseException as error:
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
        if self._frames is not None:
            self._write_frames(self._frames)
        try:
            self._cycle(reading, action, sent, verdict, times)
        finally:
            self._keep()

    def _cycle(
        self,
        reading: Reading,
        action: Action,
        sent: Mapping[str, Sent[TwistCommand]],
        verdict: Verdict,
        times: CycleTimes,
    ) -> None:
        cell, now_ns = self._cell, reading.now_ns
        for role, state in reading.states.items():
            self._add(f"/arms/{role}/tcp", state.t_ns, tcp_message(state))
        for role, wrench in reading.wrenches.items():
            self._add(f"/arms/{role}/wrench", wrench.t_ns, values_message(wrench))
        for role, torque in reading.external_torques.items():
            self._add(f"/arms/{role}/external_torque", torque.t_ns, values_message(torque))
        for role, estimate in reading.contacts.items():
            self._add(f"/sensors/{role}/contact", now_ns, contact_message(estimate))
        for role, sensor in cell.sensors.items():
            for topic, t_ns, message in sensor.extra_messages(now_ns):
                self._add(f"/sensors/{role}/{topic}", t_ns, message)
            if self._frames is not None and (frame := sensor.new_frame()) is not None:
                self._frames.add(role, frame.t_ns, frame.value.image)
        for name, health in reading.health.items():
            self._add(f"/health/{name}", health.t_ns, {"seq": health.seq, **health.value})
        for role, sample in reading.devices.items():
            self._add(f"/devices/{role}/reading", sample.t_ns, {"seq": sample.seq, **sample.value})
        if verdict.allow:
            for role, setting in action.settings.items():
                self._add(f"/devices/{role}/setting", now_ns, setting)
        objects = None if cell.scene is None else cell.scene.objects()
        if objects is not None:
            for name, T_world_object in objects.value.items():
                self._add(f"/objects/{name}", objects.t_ns, pose_message(T_world_object))
        for role, command in sent.items():
            self._add(f"/arms/{role}/command", command.t_ns, command_message(command))
        if verdict.violations or not verdict.allow:
            self._add("/safety", now_ns, verdict_message(verdict))
            if self._viewers is not None:
                self._view(partial(self._viewers.violations, now_ns, verdict.violations))
        if now_ns >= self._levels_ns:
            self._levels_ns = now_ns + _LEVELS_NS
            self._add("/interlocks", now_ns, levels_message(cell.supervisor.levels()))
        self._add("/task", now_ns, {"state": cell.task.state, **action.telemetry})
        self._add("/timing", now_ns, times.message())
        for record in cell.task.transitions[self._transitions_written :]:
            self._add(
                _EVENTS,
                record.t_ns,
                {"event": record.event, "from": record.source, "to": record.target, "reason": record.reason},
            )
            self._transitions_written += 1
        if self._viewers is not None and self._viewers.is_due(now_ns):
            self._view(partial(self._draw, self._viewers, reading, objects))

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

    def close(self) -> None:
        """Write the images that still wait; the run has ended."""
        frames, self._frames = self._frames, None
        if frames is None:
            return
        frames.close()
        self._write_frames(frames)
        if frames.left_out:
            self.event("images left out", f"{frames.left_out}, since compressing them took longer than they last")

    def write(self, topic: str, t_ns: int, message: Mapping[str, Any]) -> None:
        """Record one message."""
        if self._box is None and self._recorder is None:
            return
        self._add(topic, t_ns, message)
        self._keep()

    def _add(self, topic: str, t_ns: int, message: Mapping[str, Any]) -> None:
        """Encode one message, to be kept with all others of its cycle."""
        try:
            self._pending.append((topic, t_ns, self._encoder.encode(topic, message)))
        except BaseException as error:
            # A value of a plug-in's that is neither number, text, list nor mapping; the rest of the run is recorded.
            logger.exception("a message of %s is left out", topic)
            self.error = self.error or UnexpectedError(error)
            return
        if topic == _EVENTS and self._viewers is not None:
            self._view(partial(self._viewers.event, t_ns, message))

    def _keep(self) -> None:
        """Hand what is encoded to the black box first, and to the recording."""
        pending, self._pending = self._pending, []
        if self._box is not None:
            try:
                self._box.add(pending)
            except BaseException:
                logger.exception("the black box failed and takes no more messages")
                self._box = None
        if self._recorder is None:
            return
        try:
            self._recorder.write_encoded(pending)
        except RecordingError as error:
            self._give_up(error)
        except BaseException as error:
            self._give_up(UnexpectedError(error))

    def _for_viewers(self, recorder: Recorder) -> None:
        cell = self._cell
        try:
            scene = describe_scene(cell.plan)
        except BaseException:
            # A scene or a driver of a plug-in that cannot be drawn is no reason not to run.
            logger.exception("nothing is drawn in this recording")
            return
        self._viewers = ViewerRecord(recorder, scene, cell.scene_start_ns)
        self._jointed = {
            role: arm for role, arm in cell.arms.items() if role in scene.chains and isinstance(arm, JointSource)
        }

    def _draw(self, viewers: ViewerRecord, reading: Reading, objects: Stamped[Mapping[str, Array]] | None) -> None:
        """Record for viewers where everything is, as often as they show it."""
        for role, state in reading.states.items():
            viewers.arm(role, state)
        for role, arm in self._jointed.items():
            try:
                joints = arm.joints()
            except DeviceError:
                # Its pose is what the run depends on, and is watched.
                continue
            viewers.joints(role, joints)
        for role, estimate in reading.contacts.items():
            viewers.contact(role, estimate)
        if objects is not None:
            viewers.objects(objects)
        viewers.moving(reading.now_ns)
        viewers.again(reading.now_ns)

    def zero_frame(self, role: str, t_ns: int, image: ImageArray) -> None:
        """Record the image out of contact that a sensor compares others with; the arm stands meanwhile."""
        if self._recorder is None:
            return
        import cv2

        data = cv2.imencode(".png", image)[1].tobytes()
        self._zeros += 1
        try:
            # An attachment: viewers draw every image of a topic, and this is no frame of the stream.
            self._recorder.attach(f"zero_{role}_{self._zeros}.png", "image/png", data, t_ns)
        except RecordingError as error:
            self._give_up(error)

    def _write_frames(self, frames: FrameCompressor) -> None:
        try:
            if self._recorder is not None:
                frames.write_to(self._recorder)
        except RecordingError as error:
            self._give_up(error)
        if frames.error is not None:
            self._frames = None
            self._give_up(UnexpectedError(frames.error))

    def _view(self, record: Callable[[], None]) -> None:
        """Record for viewers; what fails there is no reason to stop."""
        try:
            record()
        except RecordingError as error:
            self._give_up(error)
        except BaseException:
            logger.exception("the rest of this run is not drawn")
            self._viewers = None

    def _give_up(self, error: TouchcellError) -> None:
        logger.error("recording ends: %s", error)
        self._recorder = self._viewers = None
        self.error = error
