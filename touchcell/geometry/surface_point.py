"""The point of a surface that is nearest to another point."""

from __future__ import annotations

from dataclasses import dataclass

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class SurfacePoint:
    """The point of a surface that is nearest to a query point.

    Attributes:
        distance_m: from the surface to the query point, negative below the surface.
        normal: (3,) outward unit normal there.
        point: (3,) m.
        curvatures_per_m: the larger and the smaller principal curvature there, 1/m, positive where the surface is
            convex; None where they are not known, as on a crease.
    """

    distance_m: float
    normal: Array
    point: Array
    curvatures_per_m: tuple[float, float] | None = None
