"""Monitor a stream of camera frames for lost, frozen and corrupt frames and drifting brightness. No I/O."""

from __future__ import annotations

import logging
import zlib
from collections import deque

import numpy as np

from touchcell.geometry.types import ImageArray
from touchcell.logs import OncePerCause

_logger = logging.getLogger(__name__)

_BUDGET_FRAMES = 30
_BUDGET_BAD = 10
_FINGERPRINT_BYTES = 65536
_BASELINE_FRAMES = 60
_SMOOTHING = 0.1
_BRIGHTNESS_STEP = 8


class FrameMonitor:
    """Statistics of the frames of one camera.

    A frame is *lost* when the sequence number jumps, *unread* when it was lost because the queue was not drained in
    time, *frozen* when its bytes equal those of the previous frame (sensor noise makes that next to impossible on a
    live sensor), and *bad* when it was rejected. Brightness is compared with that of the first 60 frames that were
    read.
    The first loss of each kind in a stream is logged.

    Args:
        camera: name of the camera, for the log.
    """

    def __init__(self, camera: str = "camera") -> None:
        self._camera = camera
        self._losses = OncePerCause(_logger)
        self.good = 0
        self.lost = 0
        self.unread = 0
        self.frozen = 0
        self.frozen_run = 0
        self.bad: dict[str, int] = {}
        self._recent_bad: deque[bool] = deque(maxlen=_BUDGET_FRAMES)
        self._fingerprint: int | None = None
        self._baseline: list[float] = []
        self._brightness = 0.0

    @property
    def has_too_many_bad(self) -> bool:
        """Return whether more than 10 of the last 30 frames were bad."""
        return sum(self._recent_bad) > _BUDGET_BAD

    def count_lost(self, frames: int, *, overrun: bool) -> None:
        """Count ``frames`` that never arrived; ``overrun``: the queue was full, so the reader was too slow."""
        if not frames:
            return
        if overrun:
            self.unread += frames
            self._losses.warning("unread", "%s: dropped %d frames that were not read in time", self._camera, frames)
        else:
            self.lost += frames
            self._losses.warning("lost", "%s: %d frames were lost on their way", self._camera, frames)

    def count_good(self, data: bytes) -> None:
        """Count a good frame; ``data``: its bytes as received."""
        self.good += 1
        # Sampled over the whole image, as its border may be black without noise; an odd stride hits both bytes of YUYV.
        fingerprint = zlib.crc32(data[:: len(data) // _FINGERPRINT_BYTES | 1])
        if fingerprint == self._fingerprint:
            self.frozen += 1
            self.frozen_run += 1
        else:
            self.frozen_run = 0
        self._fingerprint = fingerprint
        self._recent_bad.append(False)

    def count_bad(self, reason: str) -> None:
        """Count a frame rejected for ``reason``, a short name such as "short"."""
        self.bad[reason] = self.bad.get(reason, 0) + 1
        self._recent_bad.append(True)
        self._losses.warning(reason, "%s: dropped a bad frame (%s)", self._camera, reason.replace("_", " "))

    def record_brightness(self, image: ImageArray) -> None:
        """Record the brightness of a frame that was read."""
        brightness = float(np.mean(image[::_BRIGHTNESS_STEP, ::_BRIGHTNESS_STEP]))
        if len(self._baseline) < _BASELINE_FRAMES:
            self._baseline.append(brightness)
            self._brightness = brightness
        else:
            self._brightness += _SMOOTHING * (brightness - self._brightness)

    def reset_errors(self) -> None:
        """Begin a new stream: no previous frame, no recent errors. Counters continue."""
        self._recent_bad.clear()
        self._losses.forget()
        self._fingerprint = None
        self.frozen_run = 0

    def readings(self) -> dict[str, float | int | str | bool]:
        """Return the named readings for ``health``."""
        baseline = sum(self._baseline) / len(self._baseline) if self._baseline else 0.0
        return {
            "frames_good": self.good,
            "frames_lost": self.lost,
            "frames_unread": self.unread,
            "frames_frozen": self.frozen,
            "frozen_run": self.frozen_run,
            "frames_bad": sum(self.bad.values()),
            **{f"frames_bad_{reason}": count for reason, count in sorted(self.bad.items())},
            "brightness": self._brightness,
            "brightness_drift": (self._brightness - baseline) / baseline if baseline > 0.0 else 0.0,
        }
