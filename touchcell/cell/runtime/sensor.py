"""One tactile sensor of a running cell: its contact, its pictures, and what is recorded of both."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.recording.messages import belief_message, pose_message
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimator_spec import EstimatorContext
from touchcell.perception.runtime.pipeline import ContactPipeline, ContactSource

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import SceneTruth


@dataclass
class Sensor:
    """One tactile sensor in a running cell.

    Attributes:
        source: gives its contact.
        arm_role: role of the arm that carries it, None where nothing moves it.
        T_tcp_sensor: (4, 4) its pose in that arm's tool frame.
        truth: what is known to be true: the simulator's own contact, or the label of a replayed image.
        true_edge: the simulator's own edge, for an estimator of edges.
        frames: how images are recorded.
        watched: whether an interlock reads the images.
        threaded: whether frames are processed in a thread of their own, from ``begin`` to ``end``.
    """

    source: ContactSource
    arm_role: str | None
    T_tcp_sensor: Array
    truth: ContactSource | None = None
    true_edge: ContactSource | None = None
    frames: str = "none"
    watched: bool = False
    threaded: bool = False
    _recorded_seq: int = field(default=-1, init=False)
    _picture: tuple[int | None, float | None] = field(default=(None, None), init=False)
    _picture_seq: int = field(default=-1, init=False)

    @property
    def frame(self) -> Stamped[Frame] | None:
        """The newest frame that was processed; None from a source that processes none."""
        return self.source.frame

    def await_frame(self) -> None:
        """Wait for the first frame, so that no control cycle has to. Raises DeviceError."""
        self.source.await_frame()

    def begin(self, role: str) -> None:
        """Begin with the thread, if this sensor has one; its first frame is there. Raises DeviceError, ImageError."""
        if self.threaded and isinstance(self.source, ContactPipeline):
            self.source.begin_thread(f"perceives {role}")

    def end(self) -> None:
        """End the thread, if there is one."""
        if isinstance(self.source, ContactPipeline):
            self.source.end_thread()

    def take_zero(self) -> Stamped[Frame] | None:
        """Take the newest frame for one out of contact, and return it; None from a source that uses none."""
        frame = self.frame
        return frame if self.source.take_zero() else None

    def picture(self) -> tuple[int | None, float | None]:
        """A checksum and the mean grey level of every third pixel of the newest frame; (None, None) if not watched."""
        frame = self.frame if self.watched else None
        if frame is not None and frame.seq != self._picture_seq:
            sample = np.ascontiguousarray(frame.value.image[::3, ::3])
            self._picture = zlib.crc32(sample.data), float(sample.mean())
            self._picture_seq = frame.seq
        return self._picture

    def stage_times(self) -> dict[str, int]:
        """Nanoseconds of each perception stage in this cycle; empty for a source that has none."""
        if not isinstance(self.source, ContactPipeline):
            return {}
        times = self.source.times
        return {
            "read frame": times.read_ns,
            "preprocess": times.preprocess_ns,
            "infer": times.infer_ns,
            "filter": times.filter_ns,
        }

    def about(self) -> dict[str, Any] | None:
        """What recorded images need to be understood: the preprocessing; None when none are recorded."""
        if self.frames == "none" or not isinstance(self.source, ContactPipeline):
            return None
        return self.source.preprocessing.model_dump(mode="json")

    def new_frame(self) -> Stamped[Frame] | None:
        """Return the newest frame, once, where images are recorded."""
        frame = self.frame if self.frames != "none" else None
        if frame is None or frame.seq == self._recorded_seq:
            return None
        self._recorded_seq = frame.seq
        return frame

    def extra_messages(self, now_ns: int) -> Iterator[tuple[str, int, dict[str, Any]]]:
        """What else is recorded of this sensor in this cycle: the frame's own measurement, the truth."""
        if isinstance(self.source, ContactPipeline):
            measured = self.source.measurement
            if measured is not None and measured.belief is not None:
                yield "measurement", measured.t_ns, {"seq": measured.seq, **belief_message(measured.belief)}
        for topic, source in (("truth", self.truth), ("true_edge", self.true_edge)):
            true = None if source is None else source.update(now_ns)
            if true is not None:
                message: dict[str, Any] = {"in_contact": true.in_contact}
                if true.belief is not None:
                    message |= pose_message(se3.inverse(true.belief.mean))
                yield topic, true.t_ns, message


def build_sensor(
    plan: CellPlan,
    name: str,
    devices: Mapping[str, Device],
    scene: SceneTruth | None,
    role_of: Mapping[str, str],
    *,
    threaded: bool = False,
) -> Sensor:
    """One sensor of ``plan``, reading its device.

    Args:
        plan: a checked cell file.
        name: of the sensor in the cell file.
        devices: by name; at least its camera and the arm that carries it.
        scene: what is simulated around it, which its true contact comes from.
        role_of: roles of the arms in the task, by name.
        threaded: whether its frames are processed in a thread of their own.

    Raises:
        ModelError: its model file cannot be used.
        ConfigError: it asks for what its model does not have.
    """
    section = plan.cell.sensors[name]
    T_tcp_sensor = section.T_tcp_sensor
    truth = _truth(name, devices.get(section.mounted_on or ""), scene, T_tcp_sensor)
    edge = _true_edge(name, scene) if section.estimator.feature == "edge" else None
    context = EstimatorContext(name, cast(FrameSource, devices[name]), truth, edge)
    return Sensor(
        source=section.estimator.build(context),
        arm_role=role_of[section.mounted_on] if section.mounted_on else None,
        T_tcp_sensor=T_tcp_sensor,
        truth=truth,
        true_edge=edge,
        frames=plan.cell.recording.frames,
        watched=any(interlock.kind in ("frame_frozen", "exposure") for interlock in plan.cell.interlocks.values()),
        threaded=threaded,
    )


def _truth(name: str, mount: Device | None, scene: SceneTruth | None, T_tcp_sensor: Array) -> ContactSource | None:
    from touchcell.cell.runtime.ground_truth import LabelledContactSource, TrueContactSource
    from touchcell.drivers.replay.arm import ReplayArm

    if scene is not None:
        return TrueContactSource(scene, name)
    return LabelledContactSource(mount, T_tcp_sensor) if isinstance(mount, ReplayArm) else None


def _true_edge(name: str, scene: SceneTruth | None) -> ContactSource | None:
    from touchcell.cell.runtime.ground_truth import TrueEdgeSource

    return None if scene is None else TrueEdgeSource(scene, name)
