"""What ``_mesh.c`` computes, in NumPy and without its hierarchy: each point is compared with every face."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array


class Tree:
    """Arguments and methods of the compiled class; normals are interpolated at the nearest point of the facets."""

    def __init__(
        self,
        vertices: Array,
        faces: NDArray[np.int32],
        corner_normals: Array,
        corner_bends: Array,
        neighbours: NDArray[np.int32],
        edge_normals: Array,
        vertex_normals: Array,
    ) -> None:
        self._corners = vertices[faces]
        self._faces = faces
        self._normals = corner_normals
        self._bends = corner_bends
        self._neighbours = neighbours
        self._edge_normals = edge_normals
        self._vertex_normals = vertex_normals

    def nearest(self, x: float, y: float, z: float) -> tuple[float, ...]:
        """Return distance, normal, point and both curvatures."""
        p = np.array([x, y, z])
        if not np.isfinite(p).all():
            raise ValueError("the point is not finite")
        face, weight = self._closest(p)
        at = weight @ self._corners[face]
        distance = self._signed(p, face, weight)
        inside = weight > 1e-12
        edges = [i for i in range(3) if not inside[(i + 2) % 3]]
        # The way leaves a corner near its smooth normal but on creases.
        corner = inside.sum() == 1 and (p - at) @ self._normals[face, int(np.argmax(weight))] < 0.866 * distance
        if abs(distance) > 1e-9 and (corner or any(self._neighbours[face, i] < 0 for i in edges)):
            return (distance, *((p - at) / distance).tolist(), *at.tolist(), np.nan, np.nan)
        normal = weight @ self._normals[face]
        normal /= np.linalg.norm(normal)
        rise = np.einsum("i,ic,ic->i", weight, self._corners[face] - at, self._normals[face])
        lifted = at + 0.5 * rise @ self._normals[face]
        gap = float((p - lifted) @ normal)
        xx, yy, zz, xy, xz, yz = weight @ self._bends[face]
        half = 0.5 * (xx + yy + zz)
        minors = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
        root = float(np.sqrt(max(half * half - minors, 0.0)))
        return (gap, *normal.tolist(), *lifted.tolist(), float(half + root), float(half - root))

    def distances(self, points: Array) -> Array:
        """Return the signed distances to the facets."""
        return np.array([self._signed(p, *self._closest(p)) for p in points])

    def _closest(self, p: Array) -> tuple[int, Array]:
        a, b, c = (self._corners[:, i] for i in range(3))
        best = np.full(len(a), np.inf)
        weights = np.zeros((len(a), 3))
        for i, (start, end) in enumerate(((a, b), (b, c), (c, a))):
            side = end - start
            length = np.maximum(np.einsum("mc,mc->m", side, side), 1e-300)
            t = np.clip(np.einsum("mc,mc->m", p - start, side) / length, 0.0, 1.0)
            squared = np.sum((start + t[:, None] * side - p) ** 2, axis=1)
            nearer = squared < best
            best[nearer] = squared[nearer]
            weights[nearer] = 0.0
            weights[nearer, i], weights[nearer, (i + 1) % 3] = (1.0 - t)[nearer], t[nearer]
        normal = np.cross(b - a, c - a)
        doubled = np.maximum(np.einsum("mc,mc->m", normal, normal), 1e-300)
        over = [np.einsum("mc,mc->m", np.cross(v - u, p - u), normal) / doubled for u, v in ((b, c), (c, a), (a, b))]
        inside = np.all(np.stack(over) >= 0.0, axis=0)
        weights[inside] = np.stack(over, axis=1)[inside]
        best[inside] = (np.einsum("mc,mc->m", p - a, normal) ** 2 / doubled)[inside]
        face = int(np.argmin(best))
        return face, weights[face]

    def _signed(self, p: Array, face: int, weight: Array) -> float:
        off = p - weight @ self._corners[face]
        inside = weight > 1e-12
        if inside.all():
            a, b, c = self._corners[face]
            outward = np.cross(b - a, c - a)
        elif inside.sum() == 1:
            outward = self._vertex_normals[self._faces[face, int(np.argmax(weight))]]
        else:
            outward = self._edge_normals[face, (int(np.argmin(weight)) + 1) % 3]
        return float(np.copysign(np.linalg.norm(off), off @ outward))
