"""Planar paths: straight segments between points, extended beyond the last one in its direction."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from math import hypot

from touchcell.control.errors import ControlError

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Place:
    """Projection of a point onto a path.

    Attributes:
        along_m: arc length of the nearest point on the path; beyond the path's length after its end.
        cross_track_error_m: distance from the path, positive to its left.
    """

    along_m: float
    cross_track_error_m: float


class Path:
    """Straight segments between points, m.

    Args:
        points: two or more; consecutive points differ.

    Raises:
        ControlError: there are fewer, or two consecutive points are equal.
    """

    def __init__(self, points: Sequence[Point]) -> None:
        if len(points) < 2:
            raise ControlError("path", f"has {len(points)} points, not two or more", points)
        lengths = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points)]
        if min(lengths) < 1e-9:
            raise ControlError("path", "has the same point twice in a row", points)
        self._starts = list(points[:-1])
        self._end = points[-1]
        self._directions = [
            ((b[0] - a[0]) / length, (b[1] - a[1]) / length)
            for (a, b), length in zip(pairwise(points), lengths, strict=True)
        ]
        self._reached = [0.0, *accumulate(lengths)]

    @property
    def length_m(self) -> float:
        """Length from the first point to the last."""
        return self._reached[-1]

    @property
    def end(self) -> Point:
        """The last point."""
        return self._end

    def point(self, along_m: float) -> Point:
        """Return the point at arc length ``along_m``, which may lie beyond the end."""
        i = self._piece(along_m)
        rest = along_m - self._reached[i]
        return self._starts[i][0] + rest * self._directions[i][0], self._starts[i][1] + rest * self._directions[i][1]

    def direction(self, along_m: float) -> Point:
        """Return the unit vector of the segment at arc length ``along_m``."""
        return self._directions[self._piece(along_m)]

    def place(self, p: Point, since_m: float, within_m: float) -> Place:
        """Project ``p`` onto the path between ``since_m`` and ``within_m`` further, so that loops are not ambiguous."""
        best, nearest = Place(since_m, 0.0), float("inf")
        last = len(self._starts) - 1
        for i in range(self._piece(since_m), last + 1):
            if self._reached[i] > since_m + within_m:
                break
            dx, dy = p[0] - self._starts[i][0], p[1] - self._starts[i][1]
            ux, uy = self._directions[i]
            rest = dx * ux + dy * uy
            if i < last:
                rest = min(rest, self._reached[i + 1] - self._reached[i])
            if i > 0:
                rest = max(rest, 0.0)
            away = hypot(dx - rest * ux, dy - rest * uy)
            if away < nearest:
                nearest = away
                left = ux * dy - uy * dx
                best = Place(self._reached[i] + rest, away if left >= 0.0 else -away)
        return best

    def _piece(self, along_m: float) -> int:
        return min(max(bisect_right(self._reached, along_m) - 1, 0), len(self._starts) - 1)
