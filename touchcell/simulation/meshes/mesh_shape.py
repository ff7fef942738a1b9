"""A triangle mesh as a shape: nearest point, normal and curvature of the smooth surface that it stands for."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Protocol, cast

import numpy as np

from touchcell.compiled import extension
from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.simulation.meshes import _plain_mesh
from touchcell.simulation.meshes.creases import Polylines, creases
from touchcell.simulation.meshes.smoothing import SmoothMesh, TriangleMesh, smooth


class _Search(Protocol):
    def nearest(self, x: float, y: float, z: float, /) -> tuple[float, ...]: ...
    def distances(self, points: Array, /) -> Array: ...


class MeshShape:
    """A mesh, in its own frame.

    Distances are those of the smooth surface through the vertices with the corner normals (half of Phong tessellation,
    which is exact for quadratic surfaces); on creases and borders those of the facets.

    Args:
        mesh: vertices and faces; the outside is where their normals point.
        crease_rad: edges whose faces meet at more than this stay sharp.
    """

    def __init__(self, mesh: TriangleMesh, crease_rad: float) -> None:
        self._smooth = made = smooth(mesh, crease_rad)
        compiled = extension("touchcell.simulation.meshes._mesh")
        self._tree = cast(_Search, (compiled or _plain_mesh).Tree(*_arguments(made)))

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m, with both curvatures away from creases."""
        found = self._tree.nearest(*p.tolist())
        curvatures = None if math.isnan(found[7]) else (found[7], found[8])
        return SurfacePoint(found[0], np.array(found[1:4]), np.array(found[4:7]), curvatures)

    def distances(self, points: Array) -> Array:
        """Return the (k,) signed distances of ``points`` (k, 3) m to the facets."""
        return self._tree.distances(np.ascontiguousarray(points, dtype=np.float64))

    def drawn(self) -> TriangleMesh:
        """Return the mesh itself."""
        return self._smooth.mesh

    @cached_property
    def edges(self) -> Polylines:
        """The creases and borders, as curves."""
        return creases(self._smooth)


def _arguments(made: SmoothMesh) -> tuple[Array, ...]:
    arrays = (
        made.mesh.vertices,
        made.mesh.faces,
        made.normals,
        made.bends,
        made.neighbours,
        made.edge_normals,
        made.vertex_normals,
    )
    return tuple(np.ascontiguousarray(each) for each in arrays)
