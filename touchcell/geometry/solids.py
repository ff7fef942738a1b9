"""Simple shapes to draw, in metres, each in a frame of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Cuboid:
    """A box about its origin; ``size_m`` are the lengths of its sides."""

    size_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about its origin, its axis along z."""

    radius_m: float
    length_m: float


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball about its origin."""

    radius_m: float


@dataclass(frozen=True, slots=True)
class Polyline:
    """A line through ``points_m`` (n, 3)."""

    points_m: Array


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles: ``vertices_m`` (n, 3) and the corners of each triangle (m, 3), anticlockwise seen from outside."""

    vertices_m: Array
    triangles: NDArray[np.int64]


Solid = Cuboid | Cylinder | Sphere | Mesh | Polyline


def extrude(outline_m: Array, bottom_m: float, top_m: float) -> Mesh:
    """Return a convex outline (n, 2), anticlockwise, extruded along z."""
    n = len(outline_m)
    bottom = np.column_stack([outline_m, np.full(n, bottom_m)])
    top = np.column_stack([outline_m, np.full(n, top_m)])
    triangles = []
    for i in range(n):
        j = (i + 1) % n
        triangles += [(i, j, n + j), (i, n + j, n + i)]
    for i in range(1, n - 1):
        triangles += [(0, i + 1, i), (n, n + i, n + i + 1)]
    return Mesh(np.concatenate([bottom, top]), np.array(triangles))


def height_field(x_m: Array, y_m: Array, z_m: Array) -> Mesh:
    """Return the surface ``z_m`` (n, m) over ``x_m`` (n,) and ``y_m`` (m,), seen from above."""
    n, m = len(x_m), len(y_m)
    X, Y = np.meshgrid(x_m, y_m, indexing="ij")
    corner = np.arange(n * m).reshape(n, m)
    a, b, c, d = (each.ravel() for each in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Mesh(np.column_stack([X.ravel(), Y.ravel(), z_m.ravel()]), triangles)


def triangulated(solid: Solid, around: int = 24) -> Mesh:
    """Return a solid as triangles; ``around`` is how many edges a circle gets. A polyline has none."""
    if isinstance(solid, Mesh):
        return solid
    if isinstance(solid, Polyline):
        return Mesh(solid.points_m, np.empty((0, 3), dtype=np.int64))
    if isinstance(solid, Cuboid):
        x, y, z = (0.5 * size for size in solid.size_m)
        return extrude(np.array([[-x, -y], [x, -y], [x, y], [-x, y]]), -z, z)
    angle = np.linspace(0.0, 2.0 * math.pi, around, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    if isinstance(solid, Cylinder):
        return extrude(solid.radius_m * circle, -0.5 * solid.length_m, 0.5 * solid.length_m)
    rings = around // 2
    polar = np.linspace(0.0, math.pi, rings + 1)
    points = solid.radius_m * np.stack(
        [
            np.sin(polar)[:, None] * circle[:, 0],
            np.sin(polar)[:, None] * circle[:, 1],
            np.cos(polar)[:, None] * np.ones(around),
        ],
        axis=-1,
    )
    corner = np.arange((rings + 1) * around).reshape(rings + 1, around)
    after = np.roll(corner, -1, axis=1)
    a, b, c, d = (each.ravel() for each in (corner[:-1], corner[1:], after[1:], after[:-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Mesh(points.reshape(-1, 3), triangles)
