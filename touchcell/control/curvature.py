"""Curvature of what is followed: the turn of the contact frame per distance, estimated over the last stretch of it.

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
_CORNER_RAD: Final = math.radians(12.0)
"""From one estimate to the next: no bend but a corner, behind which nothing is known of the bend."""


class CurvatureEstimator:
    """Least-squares turn per distance over the last stretch of the way.

    Args:
        window_m: length of that stretch.
    """

    def __init__(self, window_m: float) -> None:
        self._window_m = window_m
        self._samples: deque[tuple[float, Array]] = deque()
        self._way_m = 0.0
        self._turned = np.zeros(3)
        self._R_base_f: Array | None = None
        self._newest: Array | None = None

    def update(self, step_m: float, T_base_sensor: Array, T_s_f: Array | None) -> None:
        """Add ``step_m`` to the way, and the contact felt there unless it is the one before."""
        self._way_m += abs(step_m)
        if T_s_f is None or T_s_f is self._newest:
            return
        self._newest = T_s_f
        R_base_f = T_base_sensor[:3, :3] @ T_s_f[:3, :3]
        if self._R_base_f is not None:
            relative = np.eye(4)
            relative[:3, :3] = self._R_base_f.T @ R_base_f
            turn = se3.log(relative)[3:]
            if float(np.linalg.norm(turn)) > _CORNER_RAD:
                self._samples.clear()
            self._turned = self._turned + turn
        self._R_base_f = R_base_f
        self._samples.append((self._way_m, self._turned))
        while self._samples and self._way_m - self._samples[0][0] > self._window_m:
            self._samples.popleft()

    def rad_per_m(self) -> Array:
        """Return the turn (3,) about the axes of the contact frame per metre; zero until enough has been felt."""
        if len(self._samples) < _FEWEST:
            return np.zeros(3)
        way = np.array([each for each, _ in self._samples])
        turned = np.stack([each for _, each in self._samples])
        off = way - way.mean()
        spread = float(off @ off)
        slope: Array = off @ (turned - turned.mean(axis=0)) / spread if spread > 1e-12 else np.zeros(3)
        return slope
