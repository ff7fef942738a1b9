"""Let go of an arm that rests, slowly. Pure arithmetic, no bus and no clock."""

from __future__ import annotations

from typing import Final

import numpy as np

from touchcell.geometry.types import Array

FADE_S: Final = 6.0
LONGEST_S: Final = 15.0
_STILL_S = 1.0
_STILL_RAD = np.deg2rad(0.3)


class Fade:
    """Share of stiffness and of gravity's torque that is left, down to none; then damping alone until nothing moves.

    What rests on a support, or at the end of a joint's range, is still held by the other joints. Motors that are
    disabled while it sinks against their damping drop it the rest of the way.

    Args:
        q: (n,) rad measured where it begins.
        start_s: when it begins.
    """

    def __init__(self, q: Array, start_s: float) -> None:
        self._start_s = start_s
        self._still = q.copy()
        self._since_s = start_s + FADE_S

    def share(self, q: Array, now_s: float) -> float | None:
        """Return the share that is left now, 0 to 1; None when the motors may be disabled.

        They may when no joint has moved by 0.3 deg within a second without stiffness, and after ``LONGEST_S`` in any
        case.

        Args:
            q: (n,) rad measured.
            now_s: on the clock of ``start_s``.
        """
        faded_s = now_s - self._start_s - FADE_S
        if np.abs(q - self._still).max() > _STILL_RAD:
            self._still, self._since_s = q.copy(), max(now_s, self._start_s + FADE_S)
        if now_s - self._since_s > _STILL_S or now_s - self._start_s > LONGEST_S:
            return None
        return max(-faded_s / FADE_S, 0.0)
