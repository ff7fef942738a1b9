"""The smooth surface that a triangle mesh stands for: normals and curvature at the corners of its faces.

Faces that meet at no more than the crease angle belong to one smooth piece. Its normals are those of Max (1999), which
are exact on a sphere whatever its triangles; curvature is the change of these normals over each face, averaged over the
faces around a corner (Rusinkiewicz 2004).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.indexing import connected

Indices = NDArray[np.int32]

_UNEVEN: Final = 16.0
"""Largest over smallest face around a corner from which the largest sets the normal: a flat beside a fine fillet."""
_BORDER_PASSES: Final = 3
"""Each mends the bend of the corners next to a border by the better normals on it."""
_MOST_MENDED_COS: Final = np.cos(np.radians(15.0))
_SYMMETRIC: Final = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Vertices and faces. Two are equal if they are one: what is computed from one can be kept for it.

    Attributes:
        vertices: (n, 3) m.
        faces: (m, 3) indices of vertices, counter-clockwise seen from outside.
        normals: (m, 3, 3) unit normals at the corners of the faces, NaN where nothing but the faces tells; None where
            nothing does anywhere.
    """

    vertices: Array
    faces: Indices
    normals: Array | None = None

    def face_normals(self) -> Array:
        """Return (m, 3) normals, twice as long as the faces' areas."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return np.cross(b - a, c - a)


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of a mesh; edge i of a face leads from its corner i to its corner i + 1.

    Attributes:
        other: (m, 3) the face across each edge; -1 where there is none or more than one.
        other_edge: (m, 3) which edge of that face it is.
        open_count: number of edges with one face.
        crowded_count: number of edges with more than two faces.
        flipped_count: number of edges whose two faces disagree about the outside.
    """

    other: Indices
    other_edge: Indices
    open_count: int
    crowded_count: int
    flipped_count: int

    @classmethod
    def of(cls, faces: Indices) -> Edges:
        """Return the edges of ``faces`` (m, 3)."""
        start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
        key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
        order = np.argsort(key, kind="stable")
        _, first, count = np.unique(key[order], return_index=True, return_counts=True)
        pairs = first[count == 2]
        one, two = order[pairs], order[pairs + 1]
        agree = start[one] == end[two]
        other = np.full(len(key), -1, np.int32)
        other_edge = np.zeros(len(key), np.int32)
        for here, there in ((one[agree], two[agree]), (two[agree], one[agree])):
            other[here], other_edge[here] = there // 3, there % 3
        return cls(
            other.reshape(-1, 3),
            other_edge.reshape(-1, 3),
            int(np.sum(count == 1)),
            int(np.sum(count > 2)),
            int(np.sum(~agree)),
        )


@dataclass(frozen=True, slots=True)
class SmoothMesh:
    """A mesh with what its nearest points need.

    Attributes:
        mesh: vertices and faces.
        normals: (m, 3, 3) unit normal of each corner of each face.
        bends: (m, 3, 6) shape operator xx yy zz xy xz yz at each corner, 1/m, positive where the surface is convex.
        neighbours: (m, 3) the face across each smooth edge; -1 for creases and borders.
        edge_normals: (m, 3, 3) sum of the normals of both faces of each edge.
        vertex_normals: (n, 3) sum of the normals around each vertex, weighted by their angles.
    """

    mesh: TriangleMesh
    normals: Array
    bends: Array
    neighbours: Indices
    edge_normals: Array
    vertex_normals: Array


@lru_cache(maxsize=2)
def smooth(mesh: TriangleMesh, crease_rad: float) -> SmoothMesh:
    """Return ``mesh`` with normals and curvature; edges sharper than ``crease_rad`` stay sharp.

    The last two are kept: a check asks several times, and 300 000 faces take two seconds.
    """
    faces, vertices = mesh.faces, mesh.vertices
    edges = Edges.of(faces)
    doubled = mesh.face_normals()
    area = np.linalg.norm(doubled, axis=1)
    normal = doubled / np.maximum(area, 1e-300)[:, None]

    told = mesh.normals if mesh.normals is not None and crease_rad > 0.0 else np.full((len(faces), 3, 3), np.nan)
    cos = np.einsum("mec,mc->me", *_facing(normal, told, edges.other))
    is_smooth = (edges.other >= 0) & (cos >= np.cos(crease_rad) - 1e-12)
    neighbours = np.where(is_smooth, edges.other, -1).astype(np.int32)

    group = _groups(faces, neighbours, edges.other_edge)
    normals = _corner_normals(vertices, faces, normal, area, group)
    normals = _on_borders(vertices, faces, normal, area, normals, group, neighbours)
    normals = _as_told(normals, told, group)
    bends = _corner_bends(vertices, faces, normal, area, normals, group)

    edge_normals = np.where((edges.other >= 0)[..., None], normal[edges.other] + normal[:, None], normal[:, None])
    vertex_normals = np.zeros_like(vertices)
    for i in range(3):
        a, b = (vertices[faces[:, (i + k) % 3]] - vertices[faces[:, i]] for k in (1, 2))
        angle = np.arctan2(area, np.einsum("mc,mc->m", a, b))
        np.add.at(vertex_normals, faces[:, i], angle[:, None] * normal)
    return SmoothMesh(mesh, normals, bends, neighbours, edge_normals, vertex_normals)


def _facing(normal: Array, told: Array, other: Indices) -> tuple[Array, Array]:
    """Return the normals of the faces across each edge (m, 3, 3) and of the faces (m, 3), to tell how they meet.

    Slivers of a cut face anywhere: where the normals at all corners of a face are told, it faces as they do.
    """
    mean = told.mean(axis=1)
    faces = np.where(np.isfinite(mean).all(axis=1, keepdims=True), mean, normal)
    faces = faces / np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-300)
    return faces[other], faces


def _as_told(normals: Array, told: Array, group: NDArray[np.int64]) -> Array:
    """Return the corner normals (m, 3, 3) with those of groups that are told in their place: their mean."""
    known = np.isfinite(told).all(axis=2)
    if not known.any():
        return normals
    total = np.zeros((group.size, 3))
    np.add.at(total, group[known.ravel()], told[known])
    length = np.linalg.norm(total, axis=1)
    mean = (total / np.maximum(length, 1e-300)[:, None])[group].reshape(-1, 3, 3)
    return np.ascontiguousarray(np.where((length[group] > 0.0).reshape(-1, 3, 1), mean, normals))


def _groups(faces: Indices, neighbours: Indices, other_edge: Indices) -> NDArray[np.int64]:
    """Return (3 m) the group of each corner: corners at one vertex that smooth edges connect."""
    face, edge = np.nonzero(neighbours >= np.arange(len(faces))[:, None])
    other, back = neighbours[face, edge], other_edge[face, edge]
    # Across an edge the start of one face's is the end of the other's.
    here = np.concatenate([3 * face + edge, 3 * face + (edge + 1) % 3])
    there = np.concatenate([3 * other + (back + 1) % 3, 3 * other + back])
    return connected(faces.size, here, there)


def _corner_normals(vertices: Array, faces: Indices, normal: Array, area: Array, group: NDArray[np.int64]) -> Array:
    by_max, by_area = np.zeros((faces.size, 3)), np.zeros((faces.size, 3))
    largest, smallest = np.zeros(faces.size), np.full(faces.size, np.inf)
    for i in range(3):
        a, b = (vertices[faces[:, (i + k) % 3]] - vertices[faces[:, i]] for k in (1, 2))
        lengths = np.einsum("mc,mc->m", a, a) * np.einsum("mc,mc->m", b, b)
        own = group[i::3]
        np.add.at(by_max, own, (area / np.maximum(lengths, 1e-300))[:, None] * normal)
        np.add.at(by_area, own, (area**2)[:, None] * normal)
        np.maximum.at(largest, own, area)
        np.minimum.at(smallest, own, area)
    total = np.where((largest > _UNEVEN * smallest)[:, None], by_area, by_max)
    length = np.linalg.norm(total, axis=1)
    corner = (total / np.maximum(length, 1e-300)[:, None])[group].reshape(-1, 3, 3)
    return np.ascontiguousarray(np.where((length[group] > 0.0).reshape(-1, 3, 1), corner, normal[:, None]))


def _on_borders(
    vertices: Array,
    faces: Indices,
    normal: Array,
    area: Array,
    normals: Array,
    group: NDArray[np.int64],
    neighbours: Indices,
) -> Array:
    """Return the corner normals (m, 3, 3) with those on and next to creases and borders mended.

    On a border the faces around a corner lie to one side of it, and so does what they say: on faces of 3 mm, the normal
    of a surface with a radius of 30 mm is 3 deg off. Of a quadratic surface with the shape operator S, the normal at
    a corner is off that of a face by d with d . e = -1/2 e . S e for both sides e of the face that leave the corner.
    """
    face, edge = np.nonzero(neighbours < 0)
    on_border = np.zeros(faces.size, bool)
    on_border[group[3 * face + edge]] = True
    on_border[group[3 * face + (edge + 1) % 3]] = True
    close = np.zeros(faces.size, bool)
    close[group.reshape(-1, 3)[on_border[group].reshape(-1, 3).any(axis=1)]] = True
    near = np.flatnonzero(close[group].reshape(-1, 3).any(axis=1))
    if not len(near):
        return normals
    faces, normal, area, own, before = faces[near], normal[near], area[near], group.reshape(-1, 3)[near], normals[near]
    label = np.unique(own, return_inverse=True)[1].ravel().astype(np.int64)
    inside = ~on_border[own]
    # A border's bend is that of the corners inside, whose normals it does not spoil.
    told = (area * inside.any(axis=1))[:, None, None]
    share = inside / np.maximum(inside.sum(axis=1, keepdims=True), 1)
    # Errors of S grow in a sliver with the square of its length over its height.
    sides = vertices[faces] - vertices[np.roll(faces, -1, axis=1)]
    stout = (area / np.maximum(np.einsum("mkc,mkc->mk", sides, sides).max(axis=1), 1e-300)) ** 2
    moved = before
    for _ in range(_BORDER_PASSES):
        bends = _corner_bends(vertices, faces, normal, area, moved, label)
        beside = np.einsum("mk,mkc->mc", share, bends)[:, None].repeat(3, axis=1)
        total = _summed(np.concatenate([told * beside, told.repeat(3, axis=1)], axis=2), label)
        known = total[..., 6] > 0.0
        bends = np.where(inside[..., None], bends, total[..., :6] / np.maximum(total[..., 6:], 1e-300))
        off = _off_face(vertices, faces, normal, bends[..., _SYMMETRIC])
        new = _summed(stout[:, None, None] * (normal[:, None] + off), label)
        new /= np.maximum(np.linalg.norm(new, axis=2, keepdims=True), 1e-300)
        usable = close[own] & (inside | known) & (np.einsum("mkc,mkc->mk", new, before) >= _MOST_MENDED_COS)
        moved = np.where(usable[..., None], new, before)
    changed = normals.copy()
    changed[near] = moved
    return changed


def _off_face(vertices: Array, faces: Indices, normal: Array, S: Array) -> Array:
    """Return (m, 3, 3) by how much the normal at each corner is off that of its face, of shape operators (m, 3, 3, 3).

    Zero where a face has no area.
    """
    off = np.zeros((len(faces), 3, 3))
    for i in range(3):
        e, f = (vertices[faces[:, (i + k) % 3]] - vertices[faces[:, i]] for k in (1, 2))
        along = [-0.5 * np.einsum("mi,mij,mj->m", side, S[:, i], side) for side in (e, f)]
        # With the dual of both sides in the plane of the face, d = (d . e) e' + (d . f) f'.
        ee, ef, ff = (np.einsum("mc,mc->m", a, b) for a, b in ((e, e), (e, f), (f, f)))
        determinant = ee * ff - ef * ef
        scale = np.where(determinant > 1e-9 * ee * ff, 1.0 / np.maximum(determinant, 1e-300), 0.0)
        off[:, i] = (scale * (ff * along[0] - ef * along[1]))[:, None] * e
        off[:, i] += (scale * (ee * along[1] - ef * along[0]))[:, None] * f
    return off


def _summed(values: Array, label: NDArray[np.int64]) -> Array:
    """Return (m, 3, k) the sum of ``values`` (m, 3, k) over all corners with the same label."""
    flat = values.reshape(-1, values.shape[2])
    total = np.zeros((int(label.max()) + 1, values.shape[2]))
    np.add.at(total, label, flat)
    return total[label].reshape(values.shape)


def _corner_bends(
    vertices: Array, faces: Indices, normal: Array, area: Array, normals: Array, group: NDArray[np.int64]
) -> Array:
    sides = [vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)]
    turns = [normals[:, k] - normals[:, 0] for k in (1, 2)]
    t = sides[0] / np.maximum(np.linalg.norm(sides[0], axis=1), 1e-300)[:, None]
    basis = np.stack([t, np.cross(normal, t)], axis=2)
    E = np.stack([np.einsum("mc,mci->mi", side, basis) for side in sides], axis=2)
    M = np.stack([np.einsum("mc,mci->mi", turn, basis) for turn in turns], axis=2)
    determinant = E[:, 0, 0] * E[:, 1, 1] - E[:, 0, 1] * E[:, 1, 0]
    usable = np.abs(determinant) > 1e-300
    inverse = (
        np.stack([np.stack([E[:, 1, 1], -E[:, 0, 1]], axis=1), np.stack([-E[:, 1, 0], E[:, 0, 0]], axis=1)], axis=1)
        / np.where(usable, determinant, 1.0)[:, None, None]
    )
    S = np.where(usable[:, None, None], M @ inverse, 0.0)
    S = 0.5 * (S + S.transpose(0, 2, 1))
    full = basis @ S @ basis.transpose(0, 2, 1)
    own = full[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    total, weight = np.zeros((faces.size, 6)), np.zeros(faces.size)
    for i in range(3):
        np.add.at(total, group[i::3], area[:, None] * own)
        np.add.at(weight, group[i::3], area)
    return np.ascontiguousarray((total / np.maximum(weight, 1e-300)[:, None])[group].reshape(-1, 3, 6))
