"""Measure the true frame rate of a camera from the stamps of its frames. No I/O, no clock."""

from __future__ import annotations

from collections import deque

_WINDOW_S = 1.0
_FEWEST_FRAMES = 30
_TOLERANCE = 0.1
# A longer gap is a stall or a full queue, which have limits of their own.
_LONGEST_GAP_PERIODS = 4.0


class FrameRate:
    """Rate of the frames that a camera made: gaps by lost frames count as the frames that their numbers say.

    Args:
        promised_hz: the rate that the camera has granted.
    """

    def __init__(self, promised_hz: float) -> None:
        self._promised_hz = promised_hz
        self._periods: deque[float] = deque(maxlen=max(_FEWEST_FRAMES, round(_WINDOW_S * promised_hz)))

    def note(self, elapsed_s: float, frames: int) -> None:
        """Record that ``frames`` frames took ``elapsed_s``."""
        period_s = elapsed_s / frames
        if period_s * self._promised_hz <= _LONGEST_GAP_PERIODS:
            self._periods.append(period_s)

    @property
    def measured_hz(self) -> float:
        """Mean rate over the last second, and at least 30 frames; 0 before two frames."""
        return len(self._periods) / sum(self._periods) if self._periods else 0.0

    @property
    def is_broken(self) -> bool:
        """Whether the rate over a whole window differs from the promised one by more than 10 %."""
        full = len(self._periods) == self._periods.maxlen
        return full and abs(self.measured_hz / self._promised_hz - 1.0) > _TOLERANCE
