"""Any shape as a triangle mesh, to be drawn or compared with what was felt."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.meshes import primitives
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.surfaces import Shape, Surface


@runtime_checkable
class Drawable(Protocol):
    """A shape that encloses a volume, or that is a sheet with a border."""

    def drawn(self) -> TriangleMesh:
        """Return the shape as a mesh, in its own frame."""
        ...


def drawn_shape(shape: Shape, centre_m: tuple[float, float] = (0.0, 0.0), reach_m: float = 0.12) -> TriangleMesh:
    """Return a mesh of ``shape`` in its own frame.

    A shape without end, or that has no mesh of its own, is drawn as seen from above: its height over a square of twice
    ``reach_m`` about ``centre_m``.
    """
    if isinstance(shape, Drawable):
        return shape.drawn()
    side = np.linspace(-reach_m, reach_m, 61)
    heights = np.array([[_height(shape, x + centre_m[0], y + centre_m[1]) for x in side] for y in side])
    sheet = primitives.height_field(heights, float(side[1] - side[0]))
    return TriangleMesh(sheet.vertices + np.array([*centre_m, 0.0]), sheet.faces)


def drawn_surface(surface: Surface, t_s: float, reach_m: float = 0.12) -> TriangleMesh:
    """Return the mesh of a surface at time ``t_s``, in the world frame."""
    T = surface.motion.pose(t_s)
    mesh = drawn_shape(surface.shape, reach_m=reach_m)
    return TriangleMesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.faces)


def _height(shape: Shape, x: float, y: float) -> float:
    p: Array = np.array([x, y, 1.0])
    for _ in range(200):
        gap = shape.nearest(p).distance_m
        p[2] -= gap
        if abs(gap) < 1e-5:
            break
    return float(p[2])
