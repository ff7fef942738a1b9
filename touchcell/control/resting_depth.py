"""How much a model misreads the depth on a surface that does not give way, from the arm's own motion.

The first touch tells the depth without a model (``touch_zero``). From there on depth grows by the sensor's way along
the normal, which the arm knows, also while the sensor turns to face the surface and begins to slide. What the model
reads beyond that is its error: another one at rest than where the skin is dragged, so that the last one is of a sensor
that slides. Over a few millimetres the errors of its normals add up to little. A surface that turns out to be soft
leaves the error as it was at the touch.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from touchcell.control.touch_zero import LARGEST_M, TouchZero, depth_of
from touchcell.geometry.types import Array

_AVERAGED: Final = 4
_ASIDE_M: Final = 6e-3
"""Distance along the surface up to which a normal that is 1 deg off counts for 0.1 mm of depth."""
_PRESSED_M: Final = 0.8e-3
_STEP_M: Final = 0.1e-3
"""Way from frame to frame of a sensor that stands: of one that moves, late frames show less than there is."""
_RESTING: Final = 0.7
"""Share of a press by which the depth that is read has to grow: a surface that is soft gives way by the rest. Models of
other tips have been seen to read 0.9 to 1.15 of it."""
_ARM_SIGMA_M: Final = 0.15e-3
"""Standard deviation of an error that the arm's motion says."""
_HISTORY_NS: Final = 200_000_000


@dataclass(frozen=True, slots=True)
class _Way:
    """From the touch on.

    Attributes:
        touched_m, newest_m: (3,) position of the sensor at the touch, and in the newest frame.
        read_m: depth that was read at the touch.
        error_m: how much of it was too much.
        along_m: way along the normals since then; the sum holds on surfaces that bend.
    """

    touched_m: Array
    newest_m: Array
    read_m: float
    error_m: float
    along_m: float = 0.0


class RestingDepth:
    """Follows one contact from its first touch until the sensor has slid a little."""

    def __init__(self) -> None:
        self._zero = TouchZero()
        self._poses: deque[tuple[int, Array]] = deque()
        self._seq = -1
        self._way: _Way | None = None
        self._errors: deque[float] = deque(maxlen=_AVERAGED)
        self.ended = False
        """True once the error is known as well as it will be."""
        self.error_m: float | None = None
        """Depth that the model reads beyond what the arm's motion says; None while it is not known."""

    def moved(self, t_ns: int, T_base_sensor: Array) -> None:
        """Take note of the sensor's pose (4, 4)."""
        self._zero.moved(t_ns, T_base_sensor)
        self._poses.append((t_ns, T_base_sensor))
        while t_ns - self._poses[0][0] > _HISTORY_NS:
            self._poses.popleft()

    def saw(self, t_frame_ns: int, seq: int, change: float, T_s_f: Array | None) -> None:
        """Take a frame into account: how much it has changed, and the contact (4, 4) that a model reads in it alone."""
        if seq == self._seq or self.ended or not self._poses:
            return
        self._seq = seq
        if self._way is not None:
            if T_s_f is not None:
                self._follow(self._way, self._pose_at(t_frame_ns), T_s_f)
            return
        self._zero.saw(t_frame_ns, seq, change, T_s_f)
        if self._zero.error_m is not None and T_s_f is not None:
            # The change at rest is right however late frames are, but not quite proportional to depth; how far the arm
            # has advanced is right if frames are stamped as they should be. Each may be off by 0.1 mm.
            self.error_m = 0.5 * (self._zero.error_m + self._zero.advance_error_m)
            touched_m = self._pose_at(t_frame_ns)[:3, 3]
            self._way = _Way(touched_m, touched_m, depth_of(T_s_f), self.error_m)

    def _follow(self, way: _Way, T_base_sensor: Array, T_s_f: Array) -> None:
        inwards = T_base_sensor[:3, :3] @ T_s_f[:3, 2]
        newest_m = T_base_sensor[:3, 3]
        from_touch = newest_m - way.touched_m
        if np.linalg.norm(from_touch - (inwards @ from_touch) * inwards) > _ASIDE_M:
            self.ended = True
            return
        step_m = newest_m - way.newest_m
        along_m = way.along_m + float(inwards @ step_m)
        self._way = replace(way, newest_m=newest_m, along_m=along_m)
        deeper_m = depth_of(T_s_f) - way.read_m
        stands = np.linalg.norm(step_m) < _STEP_M
        if stands and along_m > _PRESSED_M and deeper_m < _RESTING * along_m:
            self.error_m, self.ended = way.error_m, True
            return
        error_m = way.error_m + deeper_m - along_m
        if abs(error_m) < LARGEST_M:
            self._errors.append(error_m)
            self.error_m = float(np.mean(self._errors))

    def _pose_at(self, t_ns: int) -> Array:
        """Return the sensor's pose (4, 4) noted nearest to a time."""
        return min(self._poses, key=lambda each: abs(each[0] - t_ns))[1]


class ReadDepth:
    """What a model reads of a depth, by the arm's own motion as the sensor was pressed in.

    The arm's motion tells an error to 0.15 mm. A model that claims to know better is left alone, unless the error is
    larger than both claims explain (empirical Bayes: the variance of its error is at least what shows).
    """

    def __init__(self) -> None:
        self._beyond_m = 0.0

    def correct_depth(self, error_m: float, sigma_m: float) -> None:
        """Take note that the model reads ``error_m`` too much, and claims a standard deviation of ``sigma_m``."""
        arm = _ARM_SIGMA_M**2
        model = max(sigma_m**2, error_m**2 - sigma_m**2 - arm)
        self._beyond_m = error_m * model / (model + arm)

    @property
    def ease_m(self) -> float:
        """Depth by which less is to be read than is to be held."""
        return -self._beyond_m
