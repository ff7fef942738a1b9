"""Pieces of a mesh: those that reach into each other, and how they become one. Needs the extra ``mesh``."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.indexing import coincident_as_one, connected, has_three_corners
from touchcell.simulation.meshes.smoothing import Edges, TriangleMesh

_SHARED_M3: Final = 1e-9
_HIDDEN_M2: Final = 1e-6
"""Area of both faces where solids touch, from which they are made one: a rim there is no edge that can be touched."""
_APART_M: Final = 1e-6
_FEWEST_FACES: Final = 4


def pieces_of(edges: Edges) -> NDArray[np.int64]:
    """Return (m,) a number for each face, the same for faces that edges connect."""
    face, edge = np.nonzero(edges.other > np.arange(len(edges.other))[:, None])
    return connected(len(edges.other), face, edges.other[face, edge])


def volume_m3(mesh: TriangleMesh) -> float:
    """Return the enclosed volume, negative for a mesh that is inside out."""
    return float(_volumes(mesh).sum())


def solids_in_order(mesh: TriangleMesh) -> tuple[TriangleMesh | None, TriangleMesh]:
    """Return the solids that a file has one after another, none of which shares corners with another, and other faces.

    Programs write an assembly part by part, so the faces of each are a stretch whose edges all meet each other, also
    where parts reach into each other or share walls. None where no stretch of faces encloses a volume.
    """
    start, end = mesh.faces.astype(np.int64), np.roll(mesh.faces, -1, axis=1).astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge = np.unique(low * len(mesh.vertices) + high, return_inverse=True)
    # Each edge counts a number of its own, up or down: over a stretch that is closed they add up to nothing.
    own = np.random.default_rng(0).integers(-(2**62), 2**62, int(edge.max()) + 1)
    so_far = np.concatenate([[0], np.cumsum(np.where(start == low, 1, -1) * own[edge.reshape(start.shape)])[2::3]])
    volume = np.concatenate([[0.0], np.cumsum(_volumes(mesh))])
    following: dict[int, int] = {}
    ends = np.full(len(so_far), -1)
    for i in range(len(so_far) - 1, -1, -1):
        ends[i] = following.get(int(so_far[i]), -1)
        following[int(so_far[i])] = i
    solids, rest, i = [], np.ones(len(mesh.faces), bool), 0
    while i < len(mesh.faces):
        j = int(ends[i])
        if j - i >= _FEWEST_FACES and volume[j] - volume[i] > _SHARED_M3:
            solids.append(mesh.faces[i:j])
            rest[i:j] = False
        i = max(j, i + 1)
    if not solids:
        return None, mesh
    count = len(mesh.vertices)
    faces = np.concatenate([each + k * count for k, each in enumerate(solids)]).astype(np.int64)
    used, renumbered = np.unique(faces, return_inverse=True)
    made = TriangleMesh(mesh.vertices[used % count], np.ascontiguousarray(renumbered.reshape(-1, 3), dtype=np.int32))
    return made, TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[rest]))


def as_one(mesh: TriangleMesh) -> tuple[TriangleMesh, bool]:
    """Return a closed mesh with solids that touch or reach into each other made one, and whether any reach.

    It is ``mesh`` itself where none do either.

    Of two such solids each has faces inside or against the other, which nothing touches and on which skin, that reaches
    below the surface, would be outside; the rims of these faces are no edges to follow. Cavities, whose faces look
    into a solid, stay as they are.
    """
    piece = pieces_of(Edges.of(mesh.faces))
    piece = np.unique(piece, return_inverse=True)[1]
    solid = np.bincount(piece, _volumes(mesh)) > 0.0
    if solid.sum() < 2 or not _may_meet(*_boxes(mesh, piece), solid):
        return mesh, False
    from manifold3d import Manifold, Mesh, OpType

    solids = []
    for number in np.flatnonzero(solid).tolist():
        used, faces = np.unique(mesh.faces[piece == number], return_inverse=True)
        solids.append(Manifold(Mesh(mesh.vertices[used].astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))))
    joined = Manifold.batch_boolean(solids, OpType.Add)
    shared_m3 = sum(each.volume() for each in solids) - joined.volume()
    hidden_m2 = sum(each.surface_area() for each in solids) - joined.surface_area()
    reach = shared_m3 > _SHARED_M3
    if not reach and hidden_m2 <= _HIDDEN_M2:
        return mesh, False
    made: Any = joined.to_mesh()
    cavities = mesh.faces[~solid[piece]]
    vertices = np.concatenate([np.asarray(made.vert_properties, np.float64)[:, :3], mesh.vertices])
    faces = np.concatenate([np.asarray(made.tri_verts, np.int64), cavities + len(made.vert_properties)])
    vertices, faces = coincident_as_one(vertices, faces)
    # Where edges of both meet, faces without area join corners at one place.
    faces = faces[has_three_corners(faces)]
    # Those that touch along an edge share it now.
    return apart(TriangleMesh(vertices, np.ascontiguousarray(faces, dtype=np.int32))), reach


def apart(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with solids that share edges apart: of four faces at an edge, two with a solid between them meet.

    Faces must agree about the outside.
    """
    faces = mesh.faces
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    axis = mesh.vertices[high] - mesh.vertices[low]
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    # A fixed direction across each edge, from which angles about it count.
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    away = mesh.vertices[np.roll(faces, -2, axis=1).ravel()] - mesh.vertices[low]
    angle = np.arctan2(np.einsum("hc,hc->h", away, np.cross(axis, across)), np.einsum("hc,hc->h", away, across)).round(
        6
    )
    # The solid lies before a face whose edge leads up, and behind one whose edge leads down: first the former.
    up = start == low
    order = np.lexsort((~up, angle, high, low))
    same = np.concatenate([[False], (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])])
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(order))))
    last = np.concatenate([np.flatnonzero(~same)[1:], [len(order)]]) - 1
    following = np.where(np.isin(np.arange(len(order)), last), first, np.arange(len(order)) + 1)
    here, there = order, order[following]
    meets = ~up[here] & up[there]
    here, there = here[meets], there[meets]
    # The start of one face's edge is the end of the other's.
    after = 3 * (np.arange(faces.size) // 3) + (np.arange(faces.size) % 3 + 1) % 3
    label = connected(faces.size, np.concatenate([here, after[here]]), np.concatenate([after[there], there]))
    kept, corners = np.unique(label, return_inverse=True)
    return TriangleMesh(mesh.vertices[start[kept]], np.ascontiguousarray(corners.reshape(-1, 3), dtype=np.int32))


def has_piece_inside_out(mesh: TriangleMesh) -> bool:
    """Return True if a closed mesh has a piece whose faces look inwards and that is no cavity of another."""
    _, piece = np.unique(pieces_of(Edges.of(mesh.faces)), return_inverse=True)
    solid = np.bincount(piece, _volumes(mesh)) > 0.0
    low, high = _boxes(mesh, piece)
    return any(
        not ((low[solid] < low[i]).all(axis=1) & (high[solid] > high[i]).all(axis=1)).any()
        for i in np.flatnonzero(~solid)
    )


def _volumes(mesh: TriangleMesh) -> Array:
    """Return (m,) of the tetrahedron between each face and a point of the mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - mesh.vertices[0] for i in range(3))
    volumes: Array = np.einsum("mc,mc->m", a, np.cross(b, c)) / 6.0
    return volumes


def _boxes(mesh: TriangleMesh, piece: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return lowest and highest coordinates (k, 3) m of each piece."""
    count = int(piece.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, mesh.vertices[mesh.faces].min(axis=1))
    np.maximum.at(high, piece, mesh.vertices[mesh.faces].max(axis=1))
    return low, high


def _may_meet(low: Array, high: Array, solid: NDArray[np.bool_]) -> bool:
    low, high = low[solid] - _APART_M, high[solid]
    return any(
        bool(((low[i] < high[i + 1 :]) & (low[i + 1 :] < high[i])).all(axis=1).any()) for i in range(len(low) - 1)
    )
