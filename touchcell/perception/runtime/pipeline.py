"""Pipeline from camera frames to stamped contact estimates, with no more work than the cell needs.

A frame that is not requested is never decoded, an image without contact skips the network, and the filter runs only
where one is configured. The duration of each stage is recorded for the latency budget.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from touchcell.drivers.core.errors import EndOfStream
from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry import gaussian
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.features.feature_model import NOTHING, FeatureModel
from touchcell.perception.models.prediction import ContactEstimator
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.filter_spec import ContactFilter
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
        self._camera = camera
        self._model = model
        self._contact_gate = contact_gate
        self._filter = pose_filter
        self._zero = zero
        self._features = features
        self._timer = timer
        self._poses = PoseHistory()
        self._newest: ContactEstimate | None = None
        self._ended = False
        self._filtering = False
        self._reduced: ImageArray | None = None
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
        return self._model.header.preprocessing

    def await_frame(self) -> None:
        """Wait for the camera's first frame, which the next update processes, and compare it with the model's.

        Raises:
            DeviceError: from the camera.
            CameraError: the sensor or its camera is not the model's.
            ImageError: the camera's images do not match the model.
        """
        with suppress(EndOfStream):
            frame = self._camera.latest()
            if self._zero is not None and self._contact_gate is not None:
                zeroed = self._zero(frame.value.image, self._model, self._contact_gate)
                self._model, self._contact_gate = zeroed.estimator, zeroed.gate

    def take_zero(self) -> bool:
        """Let the contact gate compare with the newest frame from now on; False without a gate, or before a frame.

        The filter begins anew: what it knew was of a contact that is no more.
        """
        if self._contact_gate is None or self._reduced is None:
            return False
        self._contact_gate.take_zero(self._reduced)
        if self._filter is not None:
            self._filter.reset()
            self._filtering = False
        return True

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Record the sensor's pose at ``t_ns``."""
        self._poses.record(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Process the newest frame if it is new, then propagate the estimate by the sensor's motion to ``now_ns``.

        Raises:
            DeviceError: from the camera, except EndOfStream, which sets ``ended``.
            ImageError: the camera's images do not match the model.
        """
        self.times = StageTimes()
        self.measurement = None
        start = self._timer()
        try:
            frame = self._camera.latest()
        except EndOfStream:
            self._ended = True
            return self._newest
        read_ns = self._timer() - start
        # The filter cannot go back in time, so a frame older than the newest is dropped.
        if self._newest is None or frame.t_ns > self._newest.t_frame_ns:
            self.frame = frame
            self._newest = self._process(frame, read_ns)
        return self._replayed(self._newest, now_ns)

    def _process(self, frame: Stamped[Frame], read_ns: int) -> ContactEstimate:
        start = self._timer()
        reduced = self._reduced = self._model.reduce(frame.value.image)
        in_contact = self._contact_gate is None or self._contact_gate.update(reduced)
        change = None if self._contact_gate is None else self._contact_gate.score
        preprocess_ns = self._timer() - start
        if not in_contact:
            self.times = StageTimes(read_ns, preprocess_ns)
            self.measurement = Measurement(frame.seq, frame.t_ns, None)
            if self._filter is not None:
                self._filter.reset()
                self._filtering = False
            touched = None if self._features is None else NOTHING
            return ContactEstimate(False, None, frame.t_ns, frame.seq, frame.t_ns, change=change, touched=touched)
        start = self._timer()
        prediction = self._model.predict_reduced(reduced)
        touched = None
        if self._features is not None and prediction.displacements is not None:
            touched = self._features.touched(prediction.displacements)
        infer_ns = self._timer() - start
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
        self.times = StageTimes(read_ns, preprocess_ns, infer_ns, self._timer() - start)
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
            change=change,
            touched=touched,
        )

    def _replayed(self, estimate: ContactEstimate, now_ns: int) -> ContactEstimate:
        """Return the estimate propagated from its frame to now by the sensor's motion since."""
        if self._filter is None or not self._filtering or estimate.belief is None or now_ns <= estimate.t_frame_ns:
            return estimate
        belief = self._filter.predict(self._sensor_pose(now_ns), now_ns)
        return replace(estimate, belief=belief, t_ns=now_ns)

    def _sensor_pose(self, t_ns: int) -> Array:
        return self._poses.at(t_ns) if len(self._poses) else np.eye(4)
