"""The curvature of the surface under the tip, from how the felt normal has turned: it turns the sensor ahead of errors.

A controller alone follows a bend late: at 30 mm/s along a radius of 50 mm the normal turns by 34 deg/s, and by
100 deg/s over a convex crease. The turn that the next millimetres need is that of the last ones, in any direction, also
where a path turns round: the normal changes by ``S dx`` along ``dx``, with S the shape operator of the surface on which
the tip's centre moves (do Carmo, Differential Geometry of Curves and Surfaces, 3-2).
"""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np

from touchcell.geometry.types import Array

_NOISE_M: Final = 0.7e-3
"""A spread of the way that tells as much of S as knowing it to be zero."""
_FEWEST_M: Final = 2e-3
_UNEXPECTED_RAD: Final = math.radians(1.5)
"""The turn beyond what the curvature so far lets expect that halves the weight of what was felt before: a crease."""
_SHORTEST_M: Final = 2e-3
"""The way that is remembered at least."""
_SHARE: Final = 0.4
"""Of the largest turn that a bend may take, so that corrections have the rest."""
_HALF_SPEED_RAD: Final = math.radians(1.0)
"""The tilt at which the speed is halved: a bend that nothing has announced, as at a crease."""


_Three: TypeAlias = tuple[float, float, float]
_ZERO: Final[_Three] = (0.0, 0.0, 0.0)


class FeltCurvature:
    """Shape operator by least squares over the last stretch of the way, older samples counting less.

    It runs in every cycle, on so few numbers that NumPy's calls would take most of the time.

    Args:
        window_m: the way over which the weight of a sample falls to 1/e.
    """

    def __init__(self, window_m: float) -> None:
        self._window_m = window_m
        self.reset()

    def reset(self) -> None:
        """Forget what was felt."""
        self._weight = 0.0
        self._way_m = 0.0
        self._at: _Three | None = None
        self._mean_at, self._mean_normal = _ZERO, _ZERO
        # Of a symmetric matrix: xx, xy, xz, yy, yz, zz.
        self._spread = [0.0] * 6
        self._together = [_ZERO, _ZERO, _ZERO]
        self._fitted: list[_Three] | None = None

    def update(self, at: Array, normal: Array) -> None:
        """Add the inward unit normal (3,) that was felt with the tip's centre ``at`` (3,) m, both in the base frame."""
        here, felt = _three(at), _three(normal)
        step_m = 0.0 if self._at is None else math.dist(here, self._at)
        self._at = here
        self._way_m += step_m
        x, y, z = off_at = _less(here, self._mean_at)
        off_normal = _less(felt, self._mean_normal)
        kept = math.exp(-step_m / self._window_m)
        if self._weight:
            unexpected = math.dist(off_normal, _times(self._operator(), off_at))
            kept /= 1.0 + (unexpected / _UNEXPECTED_RAD) ** 4
        kept = max(kept, math.exp(-step_m / min(_SHORTEST_M, self._window_m)))
        self._weight = kept * self._weight + 1.0
        part = 1.0 / self._weight
        share = 1.0 - part
        products = (x * x, x * y, x * z, y * y, y * z, z * z)
        self._spread = [kept * old + share * new for old, new in zip(self._spread, products, strict=True)]
        self._together = [
            (kept * a + share * n * x, kept * b + share * n * y, kept * c + share * n * z)
            for (a, b, c), n in zip(self._together, off_normal, strict=True)
        ]
        self._mean_at = _less(self._mean_at, off_at, -part)
        self._mean_normal = _less(self._mean_normal, off_normal, -part)
        self._fitted = None

    def turn_rad_per_m(self, direction: Array, normal: Array) -> Array:
        """Return the turn (3,) of the normal per metre along ``direction`` (3,), a rotation vector in the base frame.

        Zero until the tip has moved by 2 mm.
        """
        if self._way_m < _FEWEST_M:
            return np.zeros(3)
        x, y, z = _three(normal)
        a, b, c = _times(self._operator(), _three(direction))
        return np.array([y * c - z * b, z * a - x * c, x * b - y * a])

    def _operator(self) -> list[_Three]:
        """Return the rows of S, 1/m: what was felt together, times the inverse of the spread."""
        if self._fitted is None:
            xx, xy, xz, yy, yz, zz = self._spread
            least = self._weight * _NOISE_M**2
            xx, yy, zz = xx + least, yy + least, zz + least
            a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
            d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
            size = 1.0 / (xx * a + xy * b + xz * c)
            inverse = [(size * a, size * b, size * c), (size * b, size * d, size * e), (size * c, size * e, size * f)]
            # The inverse is symmetric: its rows are its columns.
            self._fitted = [_times(inverse, row) for row in self._together]
        return self._fitted


def _three(vector: Array) -> _Three:
    x, y, z = vector.tolist()
    return x, y, z


def _less(one: _Three, other: _Three, share: float = 1.0) -> _Three:
    return one[0] - share * other[0], one[1] - share * other[1], one[2] - share * other[2]


def _times(rows: list[_Three], vector: _Three) -> _Three:
    x, y, z = vector
    (a, b, c), (d, e, f), (g, h, i) = rows
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


class CurvedWay:
    """Feedforward along a curved surface: turns as the curvature asks, no faster than the sensor can turn.

    Args:
        speed_m_s: on a plane.
        fastest_rad_s: the largest turn of the sensor.
        window_m: see ``FeltCurvature``.
    """

    def __init__(self, speed_m_s: float, fastest_rad_s: float, window_m: float) -> None:
        self._speed_m_s, self._fastest_rad_s = speed_m_s, fastest_rad_s
        self._curvature = FeltCurvature(window_m)
        self.speed_m_s = speed_m_s
        self.twist: Array = np.zeros(6)

    def update(self, direction: Array, T_base_sensor: Array, T_s_f: Array | None) -> Array:
        """Return the twist (6,) along the unit vector ``direction`` (3,), both in the sensor's frame.

        The speed falls where the surface turns faster than the sensor may, and with a tilt that is not yet corrected.
        """
        R = T_base_sensor[:3, :3]
        normal, slower = R[:, 2], 1.0
        if T_s_f is not None:
            normal, slower = R @ T_s_f[:3, 2], slower_by_tilt(T_s_f, _HALF_SPEED_RAD)
            self._curvature.update(T_base_sensor[:3, 3], normal)
        turn = R.T @ self._curvature.turn_rad_per_m(R @ direction, normal)
        bend = math.hypot(*turn.tolist())
        self.speed_m_s = min(slower * self._speed_m_s, _SHARE * self._fastest_rad_s / max(bend, 1e-9))
        self.twist = self.speed_m_s * np.concatenate([direction, turn])
        return self.twist


def slower_by_tilt(T_s_f: Array, half_rad: float) -> float:
    """Return the share of the speed that a sensor may have while it is tilted against a contact (4, 4).

    It is a half at a tilt of ``half_rad``.
    """
    tilt = math.acos(min(max(float(T_s_f[2, 2]), -1.0), 1.0))
    return 1.0 / (1.0 + (tilt / half_rad) ** 3)
