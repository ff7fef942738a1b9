"""Meshes of simple solids, closed and with their outsides out."""

from __future__ import annotations

import math

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.smoothing import Indices, TriangleMesh


def grid_faces(rows: int, columns: int, *, closed: bool) -> Indices:
    """Return the faces of a grid of vertices, row by row; ``closed`` joins the last column to the first."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij")
    a = (row * columns + column).ravel()
    b = (row * columns + (column + 1) % columns).ravel()
    return np.concatenate([np.stack([a, b, b + columns], 1), np.stack([a, b + columns, a + columns], 1)]).astype(
        np.int32
    )


def turned(profile: Array, sections: int) -> TriangleMesh:
    """Return the solid of revolution about z of a profile (k, 2) of radius and height, from bottom to top.

    Its first and last point must be on the axis.
    """
    angle = np.arange(sections) * 2.0 * math.pi / sections
    inner = profile[1:-1]
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.concatenate(
        [inner[:, None, :1] * ring, np.broadcast_to(inner[:, None, 1:], (*inner.shape[:1], sections, 1))], axis=2
    )
    vertices = np.concatenate([rings.reshape(-1, 3), [[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]]])
    bottom, top, last = len(vertices) - 2, len(vertices) - 1, (len(inner) - 1) * sections
    here, there = np.arange(sections), (np.arange(sections) + 1) % sections
    fans = [
        np.stack([np.full(sections, bottom), there, here], axis=1),
        np.stack([np.full(sections, top), last + here, last + there], axis=1),
    ]
    return TriangleMesh(
        vertices, np.concatenate([grid_faces(len(inner), sections, closed=True), *fans]).astype(np.int32)
    )


def ball(radius_m: float, rows: int = 65, sections: int = 128) -> TriangleMesh:
    """Return a sphere about the origin."""
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, rows)
    profile = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return turned(profile, sections)


def cylinder(radius_m: float, height_m: float, sections: int = 256) -> TriangleMesh:
    """Return a cylinder about z that stands on z = 0."""
    return turned(np.array([[0.0, 0.0], [radius_m, 0.0], [radius_m, height_m], [0.0, height_m]]), sections)


def box(size_m: Array) -> TriangleMesh:
    """Return a box of ``size_m`` (3,) that stands on z = 0 with its centre on the z axis."""
    x, y, z = 0.5 * size_m[0], 0.5 * size_m[1], size_m[2]
    vertices = np.array([[i, j, k] for k in (0.0, z) for j in (-y, y) for i in (-x, x)])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return TriangleMesh(vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32))


def superquadric(radii_m: Array, e1: float, e2: float, rows: int = 129, sections: int = 256) -> TriangleMesh:
    """Return the superquadric ((x/a)^(2/e2) + (y/b)^(2/e2))^(e2/e1) + (z/c)^(2/e1) = 1 (Barr 1981)."""
    sphere = ball(1.0, rows, sections)
    x, y, z = np.abs(sphere.vertices.T)
    inside = (x ** (2.0 / e2) + y ** (2.0 / e2)) ** (e2 / e1) + z ** (2.0 / e1)
    return TriangleMesh(radii_m * sphere.vertices * (inside ** (-0.5 * e1))[:, None], sphere.faces)


def height_field(heights_m: Array, spacing_m: float) -> TriangleMesh:
    """Return a sheet of ``heights_m`` (rows along y, columns along x), its centre at the origin."""
    rows, columns = heights_m.shape
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * spacing_m for n in (columns, rows))
    vertices = np.stack([*np.meshgrid(x, y), heights_m], axis=2).reshape(-1, 3)
    return TriangleMesh(vertices, grid_faces(rows, columns, closed=False))
