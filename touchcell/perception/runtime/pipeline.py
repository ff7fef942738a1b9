"""Pipeline from camera frames to stamped contact estimates, with no more work than the cell needs.

A frame that is not requested is never decoded, an image without contact skips the network, and the filter runs only
where one is configured. The duration of each stage is recorded for the latency budget.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry import gaussian
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.features.feature_model import FeatureModel
from touchcell.perception.models.prediction import ContactEstimator
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.filter_spec import ContactFilter
from touchcell.perception.runtime.frame_stage import Frames, FrameStage, Seen, ThreadedStage
from touchcell.perception.runtime.motion import PoseHistory
from touchcell.perception.runtime.zero import ZeroFrame

Timer = Callable[[], int]


class ContactSource(Protocol):
    """Source of contact estimates of one tactile sensor."""

    @property
    def ended(self) -> bool:
        """True if no further estimate will come (the end of a recording)."""
        return False

    @property
    def frame(self) -> Stamped[Frame] | None:
        """Newest frame that was processed; None for a source that reads no camera."""
        return None

    def await_frame(self) -> None:
        """Wait for the first frame, so that no control cycle has to. Raises DeviceError."""
        return

    def take_zero(self) -> bool:
        """Take the newest frame for one out of contact; return False for a source that compares with none."""
        return False

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Record the sensor's pose at ``t_ns``; called before ``update``."""
        ...

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Return the newest estimate, for the time ``now_ns``; None before the first frame."""
        ...


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Duration in ns of each stage for one new frame; zero for a skipped stage."""

    read_ns: int = 0
    preprocess_ns: int = 0
    infer_ns: int = 0
    filter_ns: int = 0


@dataclass(frozen=True, slots=True)
class Measurement:
    """Measurement of a single frame: the network's Gaussian before the filter, None without contact."""

    seq: int
    t_ns: int
    belief: PoseGaussian | None


class ContactPipeline:
    """Camera, network, contact gate and filter of one sensor.

    A prediction outside the estimator's training range is marked as such and not fused: its sigma is meaningless there,
    and the filter propagates the contact by the sensor's own motion.

    Args:
        camera: an opened frame source.
        model: any estimator, with its preprocessing.
        contact_gate: detects contact without the network; None passes every frame through the network.
        pose_filter: None treats each frame independently.
        zero: compares the first frame with the model's own image out of contact; None accepts any.
        features: tells what is touched from the markers that the estimator found; None tells nothing.
        timer: nanosecond counter for stage durations; it never influences an estimate.
    """

    def __init__(
        self,
        camera: FrameSource,
        model: ContactEstimator,
        *,
        contact_gate: ContactGate | None = None,
        pose_filter: ContactFilter | None = None,
        zero: ZeroFrame | None = None,
        features: FeatureModel | None = None,
        timer: Timer = time.perf_counter_ns,
    ) -> None:
        self._stage = FrameStage(camera, model, contact_gate, zero, features, timer)
        self._frames: Frames = self._stage
        self._thread: ThreadedStage | None = None
        self._filter = pose_filter
        self._timer = timer
        self._poses = PoseHistory()
        self._newest: ContactEstimate | None = None
        self._ended = False
        self._filtering = False
        self.measurement: Measurement | None = None
        self.frame: Stamped[Frame] | None = None
        self.times = StageTimes()

    @property
    def ended(self) -> bool:
        """True if the camera's stream has ended."""
        return self._ended

    @property
    def preprocessing(self) -> Preprocessing:
        """The model's preprocessing, from camera images."""
        return self._stage.preprocessing

    def await_frame(self) -> None:
        """Wait for the camera's first frame, which the next update processes, and compare it with the model's.

        Raises:
            DeviceError: from the camera.
            CameraError: the sensor or its camera is not the model's.
            ImageError: the camera's images do not match the model.
        """
        self._stage.await_frame()

    def begin_thread(self, name: str) -> None:
        """Read frames and run the network in a thread of that name from now on, until ``end_thread``.

        Filter and motion stay with the caller of ``update``. The camera must run in real time; nothing else may read
        its frames. Raises DeviceError, ImageError for the first frame.
        """
        thread = ThreadedStage(self._stage, name)
        thread.start()
        self._frames = self._thread = thread

    def end_thread(self) -> None:
        """End the thread, if there is one; what comes after is processed in the thread of ``update``."""
        if self._thread is not None:
            self._thread.finish()
            self._frames, self._thread = self._stage, None

    def take_zero(self) -> bool:
        """Let the contact gate compare with the newest frame from now on; False without a gate, or before a frame.

        The filter begins anew: what it knew was of a contact that is no more.
        """
        if not self._frames.take_zero():
            return False
        if self._filter is not None:
            self._filter.reset()
            self._filtering = False
        return True

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Record the sensor's pose at ``t_ns``."""
        self._poses.record(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Process what is new, then propagate the estimate by the sensor's motion to ``now_ns``.

        Raises:
            DeviceError: from the camera, except EndOfStream, which sets ``ended``.
            ImageError: the camera's images do not match the model.
        """
        self.times = StageTimes()
        self.measurement = None
        new = self._frames.new()
        for seen in new:
            self.frame = seen.frame
            self._newest = self._fused(seen)
        if self._frames.ended and not new:
            self._ended = True
            return self._newest
        return None if self._newest is None else self._replayed(self._newest, now_ns)

    def _fused(self, seen: Seen) -> ContactEstimate:
        frame, prediction = seen.frame, seen.prediction
        if prediction is None:
            self.times = StageTimes(seen.read_ns, seen.preprocess_ns)
            self.measurement = Measurement(frame.seq, frame.t_ns, None)
            if self._filter is not None:
                self._filter.reset()
                self._filtering = False
            return ContactEstimate(
                False, None, frame.t_ns, frame.seq, frame.t_ns, change=seen.change, touched=seen.touched
            )
        start = self._timer()
        observed = gaussian.from_exponential(prediction.xi, prediction.covariance)
        self.measurement = Measurement(frame.seq, frame.t_ns, observed)
        belief, nis = observed, None
        if self._filter is not None:
            T_base_sensor = self._sensor_pose(frame.t_ns)
            if prediction.in_range:
                state = self._filter.update(observed, T_base_sensor, frame.t_ns)
                self._filtering = True
                belief, nis = state.belief, state.nis
            elif self._filtering:
                belief = self._filter.predict(T_base_sensor, frame.t_ns)
        self.times = StageTimes(seen.read_ns, seen.preprocess_ns, seen.infer_ns, self._timer() - start)
        return ContactEstimate(
            True,
            belief,
            frame.t_ns,
            frame.seq,
            frame.t_ns,
            in_range=prediction.in_range,
            nis=nis,
            markers=prediction.markers,
            measured=observed,
            refusal=prediction.refusal,
            change=seen.change,
            touched=seen.touched,
        )

    def _replayed(self, estimate: ContactEstimate, now_ns: int) -> ContactEstimate:
        """Return the estimate propagated from its frame to now by the sensor's motion since."""
        if self._filter is None or not self._filtering or estimate.belief is None or now_ns <= estimate.t_frame_ns:
            return estimate
        belief = self._filter.predict(self._sensor_pose(now_ns), now_ns)
        return replace(estimate, belief=belief, t_ns=now_ns)

    def _sensor_pose(self, t_ns: int) -> Array:
        return self._poses.at(t_ns) if len(self._poses) else np.eye(4)
