"""Shapes of free rigid objects: prisms, solids of revolution and balls."""

from __future__ import annotations

from dataclasses import dataclass

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Prism:
    """A convex outline extruded along z; the origin is in the middle of its bottom.

    Attributes:
        outline_m: (n, 2) corners, anticlockwise.
        height_m: along z.
    """

    outline_m: Array
    height_m: float


@dataclass(frozen=True, slots=True)
class Turned:
    """A solid of revolution about z, made of stacked cylinders; the origin is in the middle of its bottom.

    Attributes:
        sections_m: (height, radius) of each, from the bottom up. One section is a plain cylinder.
    """

    sections_m: tuple[tuple[float, float], ...]

    @property
    def height_m(self) -> float:
        """Height along z."""
        return sum(height for height, _ in self.sections_m)


@dataclass(frozen=True, slots=True)
class Ball:
    """A ball about its origin."""

    radius_m: float

    @property
    def height_m(self) -> float:
        """Diameter of the ball."""
        return 2.0 * self.radius_m


Solid = Prism | Turned | Ball
