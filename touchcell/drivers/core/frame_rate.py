"""Measure the true frame rate of a camera from the stamps of its frames. No I/O, no clock."""

from __future__ import annotations

from collections import deque

# A machine that is busy for a moment delays a part; a camera that is too slow is so in every one.
_PARTS = 5
_PART_S = 0.45
_FEWEST_FRAMES = 13.0
_TOLERANCE = 0.1


class FrameRate:
    """Rate of the frames that a camera made: gaps by lost frames count as the frames that their numbers say.

    Measured in five parts of 0.45 s, or of 13 promised frames if that is longer: another rate is found within 2.7 s.

    Args:
        promised_hz: the rate that the camera has granted.
    """

    def __init__(self, promised_hz: float) -> None:
        self._promised_hz = promised_hz
        self._part_s = max(_PART_S, _FEWEST_FRAMES / promised_hz)
        self._parts: deque[tuple[float, int]] = deque(maxlen=_PARTS)
        self._elapsed_s = 0.0
        self._frames = 0

    def note(self, elapsed_s: float, frames: int) -> None:
        """Record that ``frames`` frames took ``elapsed_s``."""
        self._elapsed_s += elapsed_s
        self._frames += frames
        if self._elapsed_s >= self._part_s:
            self._parts.append((self._elapsed_s, self._frames))
            self._elapsed_s, self._frames = 0.0, 0

    @property
    def measured_hz(self) -> float:
        """Mean rate over the last two to three seconds; 0 before two frames."""
        elapsed_s = self._elapsed_s + sum(elapsed_s for elapsed_s, _ in self._parts)
        frames = self._frames + sum(frames for _, frames in self._parts)
        return frames / elapsed_s if elapsed_s > 0.0 else 0.0

    @property
    def is_broken(self) -> bool:
        """Whether the rate of every one of the last five parts is over, or under, the promised one by 10 %."""
        if len(self._parts) < _PARTS:
            return False
        ratios = [frames / elapsed_s / self._promised_hz for elapsed_s, frames in self._parts]
        return max(ratios) < 1.0 - _TOLERANCE or min(ratios) > 1.0 + _TOLERANCE
