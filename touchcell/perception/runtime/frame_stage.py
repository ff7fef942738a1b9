"""First stage of a pipeline: what each camera frame says by itself, here or in a thread of its own.

Reading, decoding and the network take milliseconds for each frame and know nothing of the arm. What follows, the
filter, needs the sensor's pose at the time of the frame and takes a tenth of that: it stays in the loop's thread.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Protocol

from touchcell.drivers.core.errors import EndOfStream
from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry.types import ImageArray
from touchcell.perception.features.feature_model import NOTHING, FeatureModel, TouchedFeature
from touchcell.perception.models.prediction import ContactEstimator, Prediction
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.zero import ZeroFrame

_POLL_S, _AFTER_FAILURE_S = 2e-3, 20e-3
_REST: Final = 0.8
"""Part of the time between frames in which a camera is not asked: each time costs a call of the system, or more."""

_KEPT: Final = 8
"""Frames that wait for the loop; where it is later than that, the oldest are dropped."""

_END_S: Final = 5.0
"""A camera that hangs must not keep a run from its end."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What one frame says by itself.

    Attributes:
        frame: the frame.
        prediction: of the network; None without contact.
        touched: class probabilities of what is touched; None where nothing tells.
        change: score of the contact gate; None without one.
        read_ns, preprocess_ns, infer_ns: duration of each step.
    """

    frame: Stamped[Frame]
    prediction: Prediction | None
    touched: TouchedFeature | None
    change: float | None
    read_ns: int
    preprocess_ns: int
    infer_ns: int


class Frames(Protocol):
    """What a pipeline takes frames from."""

    @property
    def ended(self) -> bool:
        """True if the camera's stream has ended."""
        ...

    def new(self) -> Sequence[Seen]:
        """Return what is new since the last call, oldest first. Raises DeviceError, ImageError."""
        ...

    def take_zero(self) -> bool:
        """Let the contact gate compare with the newest frame; False without a gate, or before a frame."""
        ...


class FrameStage:
    """Camera, contact gate and network, in the caller's thread.

    Args:
        camera: an opened frame source.
        model: any estimator, with its preprocessing.
        contact_gate: detects contact without the network; None passes every frame through the network.
        zero: compares the first frame with the model's own image out of contact; None accepts any.
        features: tells what is touched from the markers that the estimator found; None tells nothing.
        timer: nanosecond counter for durations.
    """

    def __init__(
        self,
        camera: FrameSource,
        model: ContactEstimator,
        contact_gate: ContactGate | None,
        zero: ZeroFrame | None,
        features: FeatureModel | None,
        timer: Callable[[], int],
    ) -> None:
        self._camera = camera
        self._model = model
        self._contact_gate = contact_gate
        self._zero = zero
        self._features = features
        self._timer = timer
        self._newest_ns: int | None = None
        self._reduced: ImageArray | None = None
        self.ended = False

    @property
    def preprocessing(self) -> Preprocessing:
        """The model's preprocessing, from camera images."""
        return self._model.header.preprocessing

    def await_frame(self) -> None:
        """Wait for the camera's first frame and compare it with the model's own; raises as ``ContactPipeline``."""
        with suppress(EndOfStream):
            frame = self._camera.latest()
            if self._zero is not None and self._contact_gate is not None:
                zeroed = self._zero(frame.value.image, self._model, self._contact_gate)
                self._model, self._contact_gate = zeroed.estimator, zeroed.gate

    def take_zero(self) -> bool:
        """Let the contact gate compare with the newest frame; False without a gate, or before a frame."""
        if self._contact_gate is None or self._reduced is None:
            return False
        self._contact_gate.take_zero(self._reduced)
        return True

    def new(self) -> Sequence[Seen]:
        """Return what the camera's newest frame says, nothing if it was seen before. Raises DeviceError, ImageError."""
        start = self._timer()
        try:
            frame = self._camera.latest()
        except EndOfStream:
            self.ended = True
            return ()
        read_ns = self._timer() - start
        # A filter cannot go back in time, so a frame older than the newest is dropped.
        if self._newest_ns is not None and frame.t_ns <= self._newest_ns:
            return ()
        seen = self._look(frame, read_ns)
        self._newest_ns = frame.t_ns
        return (seen,)

    def _look(self, frame: Stamped[Frame], read_ns: int) -> Seen:
        start = self._timer()
        reduced = self._reduced = self._model.reduce(frame.value.image)
        in_contact = self._contact_gate is None or self._contact_gate.update(reduced)
        change = None if self._contact_gate is None else self._contact_gate.score
        preprocess_ns = self._timer() - start
        if not in_contact:
            touched = None if self._features is None else NOTHING
            return Seen(frame, None, touched, change, read_ns, preprocess_ns, 0)
        start = self._timer()
        prediction = self._model.predict_reduced(reduced)
        touched = None
        if self._features is not None and prediction.displacements is not None:
            touched = self._features.touched(prediction.displacements)
        return Seen(frame, prediction, touched, change, read_ns, preprocess_ns, self._timer() - start)


class ThreadedStage:
    """The first stage in a thread of its own, from ``start`` to ``finish``.

    The first frame is processed by ``start``, so that there is an estimate from the first cycle on. What the camera or
    the model raises is raised to the caller of ``new``, and the thread tries again.

    Args:
        stage: nothing else may use it, or read its camera's frames, meanwhile.
        name: of the thread.
    """

    def __init__(self, stage: FrameStage, name: str) -> None:
        self._stage = stage
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._finished = threading.Event()
        self._at_work = threading.Lock()
        self._seen: deque[Seen] = deque(maxlen=_KEPT)
        self._failure: BaseException | None = None

    @property
    def ended(self) -> bool:
        """True if the camera's stream has ended and all that it brought has been taken."""
        return self._stage.ended and not self._seen

    def start(self) -> None:
        """Process the first frame, and all that follow in the thread. Raises DeviceError, ImageError."""
        self._seen.extend(self._stage.new())
        self._thread.start()

    def finish(self) -> None:
        """End the thread and wait for it, no longer than a camera may take that hangs."""
        self._finished.set()
        if self._thread.ident is not None:
            self._thread.join(_END_S)

    def new(self) -> Sequence[Seen]:
        """Return what is new since the last call, oldest first. Raises what camera and model have raised."""
        found = []
        while self._seen:
            found.append(self._seen.popleft())
        if not found and (failure := self._failure) is not None:
            self._failure = None
            raise failure
        return found

    def take_zero(self) -> bool:
        """As ``FrameStage.take_zero``, once the frame at work is done; what was seen with the old zero is dropped."""
        with self._at_work:
            self._seen.clear()
            return self._stage.take_zero()

    def _run(self) -> None:
        pause_s, period_s, newest_ns = _POLL_S, math.inf, None
        while not self._finished.wait(pause_s) and not self._stage.ended:
            began_s, pause_s = time.monotonic(), _POLL_S
            try:
                with self._at_work:
                    new = self._stage.new()
                    self._seen.extend(new)
            except BaseException as error:
                # The first tells what happened; those after it say that the device has failed.
                self._failure, pause_s = self._failure or error, _AFTER_FAILURE_S
                continue
            for seen in new:
                if newest_ns is not None:
                    # A frame that was missed doubles the time once; a camera that has become slower is found out.
                    period_s = min(1e-9 * (seen.frame.t_ns - newest_ns), 1.1 * period_s)
                newest_ns = seen.frame.t_ns
                if math.isfinite(period_s):
                    pause_s = max(_POLL_S, _REST * period_s - (time.monotonic() - began_s))
