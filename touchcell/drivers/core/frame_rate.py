"""Measure the true frame rate of a camera from the stamps of its frames. No I/O, no clock."""

from __future__ import annotations

from collections import deque

_PART_S = 0.5
_FEWEST_FRAMES = 15
# A machine that is busy for a moment delays a part; a camera that is too slow is so in every one.
_PARTS = 4
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
        self._part = max(_FEWEST_FRAMES, round(_PART_S * promised_hz))
        self._periods: deque[float] = deque(maxlen=_PARTS * self._part)

    def note(self, elapsed_s: float, frames: int) -> None:
        """Record that ``frames`` frames took ``elapsed_s``."""
        period_s = elapsed_s / frames
        if period_s * self._promised_hz <= _LONGEST_GAP_PERIODS:
            self._periods.append(period_s)

    @property
    def measured_hz(self) -> float:
        """Mean rate over the last two seconds, and at least 60 frames; 0 before two frames."""
        return len(self._periods) / sum(self._periods) if self._periods else 0.0

    @property
    def is_broken(self) -> bool:
        """Whether the rate of every quarter of the last two seconds is over, or under, the promised one by 10 %."""
        if len(self._periods) < _PARTS * self._part:
            return False
        periods = list(self._periods)
        ratios = [
            self._part / sum(periods[start : start + self._part]) / self._promised_hz
            for start in range(0, len(periods), self._part)
        ]
        return max(ratios) < 1.0 - _TOLERANCE or min(ratios) > 1.0 + _TOLERANCE
