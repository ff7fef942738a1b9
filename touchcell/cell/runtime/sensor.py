"""One tactile sensor of a running cell: its contact, its pictures, and what is recorded of both."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from touchcell.cell.config.schema import (
    CellPlan,
    KnownSurface,
    MovingSurfaceSection,
    NetworkEstimator,
    SensorSection,
    StillSurfaceSection,
)
from touchcell.cell.recording.messages import belief_message, pose_message
from touchcell.cell.runtime.known_surface import KnownSurfaceSource
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.paths import MODELS
from touchcell.perception.runtime.pipeline import ContactPipeline, ContactSource

if TYPE_CHECKING:
    from touchcell.drivers.core.scene import SceneTruth
    from touchcell.perception.runtime.filter import ContactFilter

BUILTIN = "builtin:"


@dataclass
class Sensor:
    """One tactile sensor in a running cell.

    Attributes:
        source: tells its contact.
        arm_role: role of the arm that carries it, None where nothing moves it.
        T_tcp_sensor: (4, 4) its pose in that arm's tool frame.
        truth: what is known to be true: the simulator's own contact, or the label of a replayed image.
        frames: how images are recorded.
        watched: whether an interlock looks at the pictures.
    """

    source: ContactSource
    arm_role: str | None
    T_tcp_sensor: Array
    truth: ContactSource | None = None
    frames: str = "none"
    watched: bool = False
    _recorded_seq: int = field(default=-1, init=False)
    _picture: tuple[int | None, float | None] = field(default=(None, None), init=False)
    _picture_seq: int = field(default=-1, init=False)

    @property
    def frame(self) -> Stamped[Frame] | None:
        """The newest frame that was looked at; None from a source that looks at none."""
        return self.source.frame if isinstance(self.source, ContactPipeline | KnownSurfaceSource) else None

    def await_frame(self) -> None:
        """Wait for the first frame, so that no control cycle has to. Raises DeviceError."""
        if isinstance(self.source, ContactPipeline | KnownSurfaceSource):
            self.source.await_frame()

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

    def extra_messages(self, now_ns: int) -> Iterator[tuple[str, int, dict[str, Any]]]:
        """What else is recorded of this sensor in this cycle: the frame's own measurement, its image, the truth."""
        if isinstance(self.source, ContactPipeline):
            measured = self.source.measurement
            if measured is not None and measured.belief is not None:
                yield "measurement", measured.t_ns, {"seq": measured.seq, **belief_message(measured.belief)}
        frame = self.frame
        if self.frames != "none" and frame is not None and frame.seq != self._recorded_seq:
            self._recorded_seq = frame.seq
            yield "image", frame.t_ns, _image_message(frame.value.image, self.frames, frame.seq, frame.t_ns)
        if self.truth is not None:
            true = self.truth.update(now_ns)
            if true is not None:
                message: dict[str, Any] = {"in_contact": true.in_contact}
                if true.belief is not None:
                    message |= pose_message(se3.inverse(true.belief.mean))
                yield "truth", true.t_ns, message


def build_sensor(
    plan: CellPlan, name: str, devices: Mapping[str, Device], scene: SceneTruth | None, role_of: Mapping[str, str]
) -> Sensor:
    """One sensor of ``plan``, reading its device.

    Args:
        plan: a checked cell file.
        name: of the sensor in the cell file.
        devices: by name; at least its camera and the arm that carries it.
        scene: what is simulated around it, which its true contact comes from.
        role_of: roles of the arms in the task, by name.

    Raises:
        ModelError: its model file cannot be used.
        ConfigError: it asks for what its model does not have.
    """
    section = plan.cell.sensors[name]
    T_tcp_sensor = section.T_tcp_sensor
    truth = _truth(name, devices.get(section.mounted_on or ""), scene, T_tcp_sensor)
    source: ContactSource
    if isinstance(section.estimator, NetworkEstimator):
        source = _pipeline(section, section.estimator, devices[name])
    elif isinstance(section.estimator, KnownSurface):
        T_base_f = se3.from_euler_mm_deg(np.array(section.estimator.surface_mm_deg))
        source = KnownSurfaceSource(cast(FrameSource, devices[name]), T_base_f)
    else:
        assert truth is not None
        source = truth
    return Sensor(
        source=source,
        arm_role=role_of[section.mounted_on] if section.mounted_on else None,
        T_tcp_sensor=T_tcp_sensor,
        truth=truth,
        frames=plan.cell.recording.frames,
        watched=any(interlock.kind in ("frame_frozen", "exposure") for interlock in plan.cell.interlocks.values()),
    )


def _truth(name: str, mount: Device | None, scene: SceneTruth | None, T_tcp_sensor: Array) -> ContactSource | None:
    from touchcell.cell.runtime.ground_truth import LabelledContactSource, TrueContactSource
    from touchcell.drivers.replay.arm import ReplayArm

    if scene is not None:
        return TrueContactSource(scene, name)
    return LabelledContactSource(mount, T_tcp_sensor) if isinstance(mount, ReplayArm) else None


def model_path(name: str) -> Path:
    """The file behind a cell file's ``model:``: a path, or ``builtin:NAME`` for one that ships with touchcell."""
    return MODELS / f"{name.removeprefix(BUILTIN)}.safetensors" if name.startswith(BUILTIN) else Path(name)


def _pipeline(section: SensorSection, estimator: NetworkEstimator, camera: Device) -> ContactPipeline:
    import cv2

    from touchcell.perception.runtime.contact_gate import ContactGate
    from touchcell.perception.runtime.estimators import load_estimator

    # A second thread gains nothing on images of this size (PERCEPTION part 5), and takes a core from other sensors.
    cv2.setNumThreads(1)
    calibration = None if estimator.calibration is None else Path(estimator.calibration)
    model = load_estimator(model_path(estimator.model), calibration)
    pose_filter = None if estimator.filter is None else build_filter(estimator.filter)
    contact_gate = None
    if (gate := estimator.gate) is not None:
        if model.reference is None:
            raise ConfigError(
                f"model {estimator.model} holds no image out of contact, which a contact gate compares with",
                key=f"sensors.{camera.name}.estimator.gate",
                value=estimator.model,
                hint="leave out `gate:`, so that every frame goes through the network",
            )
        contact_gate = ContactGate(model.reference, enter=gate.touch_percent / 100, leave=gate.release_percent / 100)
    return ContactPipeline(cast(FrameSource, camera), model, contact_gate=contact_gate, pose_filter=pose_filter)


def build_filter(settings: StillSurfaceSection | MovingSurfaceSection) -> ContactFilter:
    """The filter that a cell file's ``filter:`` describes."""
    from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise

    drift = isotropic_noise(1e-3 * settings.drift_mm_per_sqrt_s, np.deg2rad(settings.drift_deg_per_sqrt_s))
    if isinstance(settings, StillSurfaceSection):
        return PoseFilter(drift)
    from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter

    return MovingSurfaceFilter(
        drift,
        isotropic_noise(1e-3 * settings.accel_mm_s_per_sqrt_s, np.deg2rad(settings.accel_deg_s_per_sqrt_s)),
        isotropic_noise(1e-3 * settings.speed_mm_s, np.deg2rad(settings.speed_deg_s)),
    )


def _image_message(image: Any, kind: str, seq: int, t_ns: int) -> dict[str, Any]:
    import cv2

    encoded = cv2.imencode(".jpg" if kind == "jpeg" else ".png", image)[1].tobytes()
    return {
        "timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9},
        "frame_id": str(seq),
        "format": kind,
        "data": base64.b64encode(encoded).decode(),
    }
