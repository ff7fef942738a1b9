"""Paths over a surface, planned in a plane before anything has been felt and projected onto what is felt.

The plane is that of the sensor's x and y axes where the contact settled, its origin the tip there. The sensor's
position over the plane follows the path; touch alone decides how far above or below the plane it is.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from touchcell.control.path import Path, Point
from touchcell.geometry.types import Array
from touchcell.tasks.interface import TaskConfig

_STEP_RAD: Final = math.radians(10.0)
_MOST_LINES, _MOST_TURNS = 10_000, 10_000
_APART_M: Final = 4e-3
_MOST_POINTS: Final = 400
# Where the surface is steeper than this, the way to go is taken along the surface, not exactly below the path.
_STEEPEST_COS: Final = 0.3


class RasterConfig(TaskConfig):
    """Lines to and fro over a rectangle about the first contact, from one of its corners.

    Attributes:
        size_mm: of the rectangle, along the lines and across them.
        spacing_mm: distance from line to line.
        turn_deg: direction of the lines, from the sensor's x axis towards its y axis.
    """

    kind: Literal["raster"]
    size_mm: tuple[PositiveFloat, PositiveFloat]
    spacing_mm: PositiveFloat
    turn_deg: float = 0.0

    @model_validator(mode="after")
    def _not_too_long(self) -> RasterConfig:
        if self.size_mm[1] / self.spacing_mm > _MOST_LINES:
            raise ValueError(f"spacing_mm {self.spacing_mm:g} makes more than {_MOST_LINES} lines of size_mm")
        return self

    def corners(self) -> list[Point]:
        """Return points, m, of the path that are farthest from the first contact."""
        along, across = (0.5e-3 * size for size in self.size_mm)
        sin, cos = math.sin(math.radians(self.turn_deg)), math.cos(math.radians(self.turn_deg))
        return [
            (cos * x - sin * y, sin * x + cos * y)
            for x, y in ((along, across), (-along, across), (-along, -across), (along, -across))
        ]

    def points(self) -> list[Point]:
        """Return the corners of the path, m, from the first contact on."""
        along, across = (0.5e-3 * size for size in self.size_mm)
        lines = max(math.ceil(2e3 * across / self.spacing_mm), 1) + 1
        found: list[Point] = [(0.0, 0.0)]
        for i, y in enumerate(np.linspace(-across, across, lines).tolist()):
            found += [(-along, y), (along, y)] if i % 2 == 0 else [(along, y), (-along, y)]
        sin, cos = math.sin(math.radians(self.turn_deg)), math.cos(math.radians(self.turn_deg))
        return [(cos * x - sin * y, sin * x + cos * y) for x, y in found]


class SpiralConfig(TaskConfig):
    """An Archimedean spiral about the first contact.

    Attributes:
        radius_mm: where it ends.
        spacing_mm: distance from turn to turn.
    """

    kind: Literal["spiral"]
    radius_mm: PositiveFloat
    spacing_mm: PositiveFloat

    @model_validator(mode="after")
    def _not_too_long(self) -> SpiralConfig:
        if self.radius_mm / self.spacing_mm > _MOST_TURNS:
            raise ValueError(f"spacing_mm {self.spacing_mm:g} makes more than {_MOST_TURNS} turns within radius_mm")
        return self

    def corners(self) -> list[Point]:
        """Return points, m, of the last turn."""
        radius = 1e-3 * self.radius_mm
        return [(radius * math.cos(a), radius * math.sin(a)) for a in np.linspace(0.0, 2.0 * math.pi, 9).tolist()]

    def points(self) -> list[Point]:
        """Return the corners of the path, m, from the first contact on."""
        end = 2.0 * math.pi * self.radius_mm / self.spacing_mm
        angles = np.linspace(0.0, end, max(math.ceil(end / _STEP_RAD), 2))
        radii = 1e-3 * self.radius_mm * angles / end
        return [(r * math.cos(a), r * math.sin(a)) for a, r in zip(angles.tolist(), radii.tolist(), strict=True)]


class ThroughConfig(TaskConfig):
    """Straight lines from the first contact through points.

    Attributes:
        points_mm: along the sensor's x and y axes where the contact settled.
    """

    kind: Literal["through"]
    points_mm: tuple[tuple[float, float], ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _all_different(self) -> ThroughConfig:
        points = [(0.0, 0.0), *self.points_mm]
        if any(math.dist(a, b) < 0.01 for a, b in pairwise(points)):
            raise ValueError("points_mm has the same point twice in a row, or begins with the first contact")
        return self

    def corners(self) -> list[Point]:
        """Return the points, m."""
        return self.points()[1:]

    def points(self) -> list[Point]:
        """Return the corners of the path, m, from the first contact on."""
        return [(0.0, 0.0), *((1e-3 * x, 1e-3 * y) for x, y in self.points_mm)]


PathConfig = Annotated[RasterConfig | SpiralConfig | ThroughConfig, Field(discriminator="kind")]
"""The ``path:`` of surface following."""


def along(points: list[Point]) -> list[Point]:
    """Return points, m, of the path with these corners: 4 mm apart, or on a long path at most 400."""
    path = Path(points)
    count = min(max(math.ceil(path.length_m / _APART_M), 1), _MOST_POINTS)
    return [path.point(path.length_m * i / count) for i in range(1, count + 1)]


class Guide:
    """Leads a sensor along a path that is projected onto the surface.

    Args:
        points: corners of the path, m.
        lookahead_m: how far ahead on the path the sensor heads.
    """

    def __init__(self, points: list[Point], lookahead_m: float) -> None:
        self._path = Path(points)
        self._lookahead_m = lookahead_m
        self._T_base_plane: Array | None = None
        self.along_m = 0.0
        self.cross_track_error_m = 0.0

    @property
    def length_m(self) -> float:
        """Length of the path in its plane."""
        return self._path.length_m

    def direction(self, T_base_sensor: Array) -> Array:
        """Return the unit vector (3,), along the surface and in the sensor's frame, in which to continue."""
        if self._T_base_plane is None:
            self._T_base_plane = T_base_sensor
        R, origin = self._T_base_plane[:3, :3], self._T_base_plane[:3, 3]
        x, y, _ = (R.T @ (T_base_sensor[:3, 3] - origin)).tolist()
        place = self._path.place((x, y), self.along_m, 2.0 * self._lookahead_m)
        self.along_m, self.cross_track_error_m = place.along_m, place.cross_track_error_m
        goal_x, goal_y = self._path.point(place.along_m + self._lookahead_m)
        away = math.hypot(goal_x - x, goal_y - y)
        ahead = (goal_x - x, goal_y - y) if away > 1e-9 else self._path.direction(place.along_m)
        wanted = R[:, :2] @ ahead
        axis, up = T_base_sensor[:3, 2], R[:, 2]
        steepness = float(axis @ up)
        if abs(steepness) > _STEEPEST_COS:
            wanted = wanted - float(wanted @ axis) / steepness * up
        else:
            wanted = wanted - float(wanted @ axis) * axis
        direction: Array = T_base_sensor[:3, :3].T @ wanted
        length = math.hypot(*direction.tolist())
        return direction / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
