"""What a run records for viewers: frames, the scene, beliefs, joints and a log, beside the numbers for programs."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from typing import Any, Final

from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.recording.well_known import (
    FRAME_TRANSFORM,
    JOINT_STATES,
    LOG,
    POSE_IN_FRAME,
    SCENE_UPDATE,
    BeliefMessage,
    JointMessage,
    Pose,
    TransformMessage,
    drawn_pose,
    log_message,
    scene_message,
)
from touchcell.cell.scene.description import SceneDescription
from touchcell.cell.scene.frames import (
    WORLD,
    base_frame,
    contact_frame,
    link_frame,
    object_frame,
    sensor_frame,
    tcp_frame,
)
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate

SCENE_TOPIC: Final = "/scene"
LOG_TOPIC: Final = "/log"
_PICTURE_NS: Final = round(1e9 / 30.0)
"""What is drawn is for the eye, which sees no more pictures a second; the numbers are recorded in every cycle."""
_BELIEF_NS: Final = 100_000_000
"""Where the contact is felt, and how surely, is among the numbers of every cycle; its full covariance is not."""
_AGAIN_NS: Final = 1_000_000_000
_LEVELS: Final[dict[Severity, str]] = {Severity.LIMIT: "WARNING", Severity.TRIP: "ERROR", Severity.FAULT: "FATAL"}


class ViewerRecord:
    """Writes a run's messages for viewers into its recording. Raises RecordingError as the recorder does.

    Args:
        recorder: of the run.
        scene: what the cell looks like.
        scene_start_ns: when the scene's own time began.
    """

    def __init__(self, recorder: Recorder, scene: SceneDescription, scene_start_ns: int = 0) -> None:
        self._recorder = recorder
        self._scene = scene
        self._scene_start_ns = scene_start_ns
        self._transforms: dict[str, tuple[str, TransformMessage]] = {}
        self._drawn: dict[str, Pose] = {}
        self._beliefs: dict[str, tuple[str, BeliefMessage]] = {}
        self._next_belief_ns: dict[str, int] = {}
        self._joints = {role: JointMessage(chain.joint_names) for role, chain in scene.chains.items()}
        self._next_ns = self._begun_ns = -(1 << 62)

    def begin(self, t_ns: int) -> None:
        """Write what stands still, and everything that is drawn."""
        self._begun_ns = t_ns
        self._drawn.clear()
        for frame in self._scene.frames:
            self._transform(frame.parent, frame.name, t_ns, frame.T_parent_frame)
        parts = sorted(self._scene.parts, key=lambda part: (part.name, part.frame))
        entities = [
            (f"{name} in {frame}", frame, [(part.solid, part.T_frame_solid, part.colour) for part in group])
            for (name, frame), group in groupby(parts, key=lambda part: (part.name, part.frame))
        ]
        message = scene_message(t_ns + self._recorder.wall_offset_ns, entities)
        self._recorder.write_bytes(SCENE_TOPIC, t_ns, SCENE_UPDATE, message)

    def is_due(self, t_ns: int) -> bool:
        """Return whether it is time for the next picture, which counts from there."""
        if t_ns < self._next_ns:
            return False
        self._next_ns = max(self._next_ns, t_ns - _PICTURE_NS) + _PICTURE_NS
        return True

    def arm(self, role: str, state: Stamped[TcpState]) -> None:
        """Write where an arm's tool is."""
        self._transform(base_frame(role), tcp_frame(role), state.t_ns, state.value.T_base_tcp)

    def joints(self, role: str, state: Stamped[JointState]) -> None:
        """Write the states of an arm's joints, and where its links are."""
        t_wall_ns = state.t_ns + self._recorder.wall_offset_ns
        message = self._joints[role].encode(t_wall_ns, state.value.q, state.value.dq, state.value.tau)
        self._recorder.write_bytes(f"/arms/{role}/joints", state.t_ns, JOINT_STATES, message)
        if not all_finite(state.value.q):
            return
        for number, T_base_link in enumerate(self._scene.chains[role].link_poses(state.value.q), start=1):
            self._transform(base_frame(role), link_frame(role, number), state.t_ns, T_base_link)

    def contact(self, role: str, estimate: ContactEstimate) -> None:
        """Write the belief about a sensor's contact, and the surface frame that it expects."""
        belief = estimate.belief
        if belief is None:
            return
        frame = sensor_frame(role)
        self._transform(frame, contact_frame(role), estimate.t_ns, belief.mean)
        if estimate.t_ns < self._next_belief_ns.get(role, estimate.t_ns):
            return
        self._next_belief_ns[role] = estimate.t_ns + _BELIEF_NS
        known = self._beliefs.get(role)
        if known is None:
            known = self._beliefs[role] = f"/sensors/{role}/belief", BeliefMessage(frame)
        topic, message = known
        t_wall_ns = estimate.t_ns + self._recorder.wall_offset_ns
        self._recorder.write_bytes(
            topic, estimate.t_ns, POSE_IN_FRAME, message.encode(t_wall_ns, drawn_pose(belief.mean), belief.covariance)
        )

    def objects(self, objects: Stamped[Mapping[str, Array]]) -> None:
        """Write where the free objects of the scene are."""
        for name, T_world_object in objects.value.items():
            self._transform(WORLD, object_frame(name), objects.t_ns, T_world_object)

    def again(self, t_ns: int) -> None:
        """Write what stands still again, every second, for viewers that have joined since."""
        if self._recorder.live and t_ns >= self._begun_ns + _AGAIN_NS:
            self.begin(t_ns)

    def moving(self, t_ns: int) -> None:
        """Write where the surfaces are that a prescribed motion moves."""
        for frame in self._scene.moving:
            self._transform(WORLD, frame.name, t_ns, frame.pose((t_ns - self._scene_start_ns) * 1e-9))

    def event(self, t_ns: int, message: Mapping[str, Any]) -> None:
        """Write an event as a line of the log."""
        text = str(message.get("event", ""))
        if message.get("to"):
            text += f" -> {message['to']}"
        if message.get("reason"):
            text += f": {message['reason']}"
        self._log(t_ns, "INFO", "event", text)

    def violations(self, t_ns: int, violations: tuple[Violation, ...]) -> None:
        """Write each violation as a line of the log."""
        for each in violations:
            self._log(t_ns, _LEVELS[each.severity], each.interlock, f"{each.subject}: {each.reason}")

    def _log(self, t_ns: int, level: str, name: str, text: str) -> None:
        message = log_message(t_ns + self._recorder.wall_offset_ns, level, name, text)
        self._recorder.write_bytes(LOG_TOPIC, t_ns, LOG, message)

    def _transform(self, parent: str, frame: str, t_ns: int, T_parent_frame: Array) -> None:
        if not all_finite(T_parent_frame):
            return
        pose = drawn_pose(T_parent_frame)
        # A frame stays where it was until it is written again.
        if self._drawn.get(frame) == pose:
            return
        self._drawn[frame] = pose
        known = self._transforms.get(frame)
        if known is None:
            known = self._transforms[frame] = f"/frames/{frame}", TransformMessage(parent, frame)
        topic, message = known
        data = message.encode(t_ns + self._recorder.wall_offset_ns, pose)
        self._recorder.write_bytes(topic, t_ns, FRAME_TRANSFORM, data)
