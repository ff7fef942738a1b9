"""Curvature of what is followed: the motion of the contact frame per distance, estimated over the last stretch of it.

It is the feedforward of turning: a servo alone lags behind a surface that bends by speed times curvature over its gain.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array

_FEWEST: Final = 5
_NOISE_M: Final = 0.3e-3
"""A spread of the way that tells as much of the motion as knowing it to be zero."""
_TIGHTEST_PER_M: Final = 1.0 / 6e-3
"""A corner that is felt in several steps, for no bend of what is followed is tighter."""
_LEAST_SHARE: Final = 0.8
"""Of the window, over which a bend has to be felt."""
_CORNER_RAD: Final = math.radians(12.0)
"""From one estimate to the next: no bend but a corner, behind which nothing is known of the bend."""


class CurvatureEstimator:
    """Least-squares motion of the contact frame per distance over the last stretch of the way.

    Args:
        window_m: length of that stretch.
    """

    def __init__(self, window_m: float) -> None:
        self._window_m = window_m
        self._samples: deque[tuple[float, Array]] = deque()
        self._way_m = 0.0
        self._moved = np.zeros(6)
        self._T_base_f: Array | None = None
        self._newest: Array | None = None

    def update(self, step_m: float, T_base_sensor: Array, T_s_f: Array | None) -> None:
        """Add ``step_m`` to the way, and the contact felt there unless it is the one before."""
        self._way_m += abs(step_m)
        if T_s_f is None or T_s_f is self._newest:
            return
        self._newest = T_s_f
        T_base_f = se3.compose(T_base_sensor, T_s_f)
        if self._T_base_f is not None:
            moved = se3.log(se3.compose(se3.inverse(self._T_base_f), T_base_f))
            if float(np.linalg.norm(moved[3:])) > _CORNER_RAD or np.linalg.norm(self._slope()[3:]) > _TIGHTEST_PER_M:
                self._samples.clear()
            self._moved = self._moved + moved
        self._T_base_f = T_base_f
        self._samples.append((self._way_m, self._moved))
        while self._samples and self._way_m - self._samples[0][0] > self._window_m:
            self._samples.popleft()

    def per_m(self) -> Array:
        """Return the motion (6,) of the contact frame along and about its own axes per metre, 1 and rad/m.

        Zero until it has been felt over most of the window: what an estimate errs by behind a corner is no bend.
        """
        felt_m = self._samples[-1][0] - self._samples[0][0] if self._samples else 0.0
        return self._slope() if felt_m >= _LEAST_SHARE * self._window_m else np.zeros(6)

    def _slope(self) -> Array:
        if len(self._samples) < _FEWEST:
            return np.zeros(6)
        way = np.array([each for each, _ in self._samples])
        moved = np.stack([each for _, each in self._samples])
        off = way - way.mean()
        spread = float(off @ off) + len(way) * _NOISE_M**2
        slope: Array = off @ (moved - moved.mean(axis=0)) / spread
        return slope
