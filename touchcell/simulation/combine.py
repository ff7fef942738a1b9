"""Solids made of solids, whose corners on a cut lie on the surfaces of their parts and keep the normals of these.

Cutting knows facets alone: a new corner lies on a chord of its surface, whose normal only faces to one side tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.indexing import coincident_as_one, has_three_corners
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.surfaces import Surface

Operation = Literal["union", "intersection", "difference"]

_INWARDS: Final = 1e-3
"""Share of the way to the middle of a face at which its surface is asked, so that it is the right one at a crease."""
_PARALLEL: Final = 0.05
"""Of the largest singular value: what two nearly parallel surfaces do not tell of the place where they meet."""
_MOST_MOVED_M: Final = 1e-3
_MOST_OFF_COS: Final = np.cos(np.radians(45.0))


@dataclass(frozen=True, slots=True)
class Part:
    """A solid, in the frame of the whole.

    Attributes:
        mesh: closed, with its outside out.
        surface: what the mesh stands for.
    """

    mesh: TriangleMesh
    surface: Surface


def combined(parts: Sequence[Part], operation: Operation) -> TriangleMesh:
    """Return the union or the intersection of ``parts``, or the first without the others; without faces if empty.

    Needs the extra ``mesh``.
    """
    from manifold3d import Manifold, Mesh, OpType

    first = Manifold.reserve_ids(len(parts))
    solids = [
        Manifold(
            Mesh(
                np.asarray(part.mesh.vertices, np.float32),
                np.asarray(part.mesh.faces, np.uint32),
                run_index=np.array([0, part.mesh.faces.size], np.uint32),
                run_original_id=np.array([first + i], np.uint32),
                face_id=np.arange(len(part.mesh.faces), dtype=np.uint32),
            )
        )
        for i, part in enumerate(parts)
    ]
    kind = {"union": OpType.Add, "intersection": OpType.Intersect, "difference": OpType.Subtract}[operation]
    made: Any = Manifold.batch_boolean(solids, kind).to_mesh()
    if not len(made.tri_verts):
        return TriangleMesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    vertices, faces = coincident_as_one(
        np.asarray(made.vert_properties, np.float64)[:, :3], np.asarray(made.tri_verts, np.int64)
    )
    bounds = np.asarray(made.run_index, np.int64) // 3
    runs = bounds[1:] - bounds[:-1]
    owner = np.repeat(np.asarray(made.run_original_id, np.int64) - first, runs)
    # Where edges of both parts meet, faces without area join corners at one place, or lie back to back.
    whole = has_three_corners(faces)
    _, same, times = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    whole &= times[same.ravel()] == 1
    faces, owner = faces[whole], owner[whole]
    middles, normals = _of_sources(parts, owner, np.asarray(made.face_id, np.int64)[whole])
    if operation == "difference":
        normals[owner > 0] *= -1.0
    return _on_surfaces(vertices, faces, parts, owner, middles, normals)


def _of_sources(parts: Sequence[Part], owner: NDArray[np.int64], face_id: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return (m, 3) middle and unit normal of the face of a part that each face was cut from."""
    middles, normals = np.empty((len(owner), 3)), np.empty((len(owner), 3))
    for i, part in enumerate(parts):
        own = np.flatnonzero(owner == i)
        doubled = part.mesh.face_normals()[face_id[own]]
        middles[own] = part.mesh.vertices[part.mesh.faces[face_id[own]]].mean(axis=1)
        normals[own] = doubled / np.maximum(np.linalg.norm(doubled, axis=1, keepdims=True), 1e-300)
    return middles, normals


def _on_surfaces(
    vertices: Array,
    faces: NDArray[np.int64],
    parts: Sequence[Part],
    owner: NDArray[np.int64],
    middles: Array,
    outward: Array,
) -> TriangleMesh:
    """Move the corners on cuts onto the surfaces that meet there, and ask these for the normals at and next to them."""
    count = len(vertices)
    lowest, highest = np.full(count, len(parts)), np.full(count, -1)
    np.minimum.at(lowest, faces, owner[:, None])
    np.maximum.at(highest, faces, owner[:, None])
    cut = lowest < highest
    asked = np.flatnonzero(cut[faces].any(axis=1))
    gaps: dict[int, list[tuple[Array, float]]] = {}
    for face in asked[cut[faces[asked]].any(axis=1)].tolist():
        for vertex in faces[face].tolist():
            if cut[vertex]:
                found = _asked(parts[owner[face]], vertices[vertex], middles[face], outward[face])
                if found is not None:
                    gaps.setdefault(vertex, []).append(found)
    moved = vertices.copy()
    for vertex, found_there in gaps.items():
        ways = np.array([normal for normal, _ in found_there])
        off = -np.linalg.pinv(ways, rcond=_PARALLEL) @ np.array([gap for _, gap in found_there])
        if np.linalg.norm(off) <= _MOST_MOVED_M:
            moved[vertex] += off
    normals = np.full((len(faces), 3, 3), np.nan)
    for face in asked.tolist():
        for corner, vertex in enumerate(faces[face].tolist()):
            found = _asked(parts[owner[face]], moved[vertex], middles[face], outward[face])
            if found is not None:
                normals[face, corner] = found[0]
    return TriangleMesh(moved, np.ascontiguousarray(faces, dtype=np.int32), normals)


def _asked(part: Part, corner: Array, middle: Array, outward: Array) -> tuple[Array, float] | None:
    """Return normal and distance of a part's surface at a corner of a face; None where it has another face there."""
    found = part.surface.nearest(corner + _INWARDS * (middle - corner), 0.0)
    sign = np.sign(found.normal @ outward)
    if found.curvatures_per_m is None or sign * float(found.normal @ outward) < _MOST_OFF_COS:
        return None
    return sign * found.normal, float(sign * found.distance_m)
