"""Creases and borders of a mesh as curves: what an edge-following tip follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.smoothing import Indices, SmoothMesh


@dataclass(frozen=True, slots=True)
class EdgePoint:
    """The point of an edge that is nearest to a query point.

    Attributes:
        point: (3,) m.
        tangent: (3,) unit vector along the edge.
        normals: (2, 3) unit normals of the two faces that meet there, first that of the face to the left of the
            tangent; twice the same on a border.
        outwards: (3,) sum of the directions away from the facing face, across the pieces that end there; None unless
            the point is the end of a piece, as at a corner.
    """

    point: Array
    tangent: Array
    normals: Array
    outwards: Array | None


class Polylines:
    """Straight pieces of edges, each between two faces.

    Args:
        starts, ends: (k, 3) m.
        normals: (k, 2, 2, 3) unit normals of both faces at both ends.
        tangents: (k, 2, 3) unit tangents at both ends, those of a smooth curve where pieces bend little.
    """

    def __init__(self, starts: Array, ends: Array, normals: Array, tangents: Array) -> None:
        self.starts, self.ends = starts, ends
        self._side = ends - starts
        self._squared = np.maximum(np.einsum("kc,kc->k", self._side, self._side), 1e-300)
        self._normals, self._tangents = normals, tangents
        self.middle_normals = normals.mean(axis=1)
        # Rows of one coordinate each: sums over three neighbours in memory take ten times as long.
        self._start_rows, self._side_rows = np.ascontiguousarray(starts.T), np.ascontiguousarray(self._side.T)
        self._facing_rows = np.ascontiguousarray(self.middle_normals.transpose(1, 2, 0))

    def __len__(self) -> int:
        return len(self.starts)

    def nearest(self, p: Array, facing: Array | None = None) -> EdgePoint:
        """Return the nearest point of any piece to ``p`` (3,) m.

        With ``facing`` (3,), a unit vector, only pieces with a face whose outside is towards it count, to 60 deg;
        all of them where there is none. An edge that juts out by less than 3 mm under another gives way to that: it is
        nearer to an apex pressed in between both, but the tip is pressed against the upper one.
        """
        off = p[:, None] - self._start_rows
        t = np.clip(_dot(off, self._side_rows) / self._squared, 0.0, 1.0)
        away = off - t * self._side_rows
        squared = _dot(away, away)
        if facing is not None:
            one, other = (_dot(normals, facing) for normals in self._facing_rows)
            seen = np.maximum(one, other) >= _FACING_COS
            squared = np.where(seen, squared, np.inf) if seen.any() else squared
        i = int(np.argmin(squared))
        if facing is not None:
            i = self._over(i, t, away.T, squared, facing)
        share = t[i]
        tangent = (1.0 - share) * self._tangents[i, 0] + share * self._tangents[i, 1]
        normals = (1.0 - share) * self._normals[i, 0] + share * self._normals[i, 1]
        return EdgePoint(
            self.starts[i] + share * self._side[i],
            tangent / np.linalg.norm(tangent),
            normals / np.linalg.norm(normals, axis=1, keepdims=True),
            self._outwards_at(self.starts[i] if share <= 0.0 else self.ends[i], facing)
            if facing is not None and not 0.0 < share < 1.0
            else None,
        )

    def _over(self, i: int, t: Array, away: Array, squared: Array, facing: Array) -> int:
        """Return the uppermost of the pieces over piece i, among those that are not only near with their neighbours."""
        near = np.flatnonzero(squared < _FARTHEST_OVER_M**2)
        up = away[i] - away[near]
        height = up @ facing
        # Other sides of a corner or of a narrow ring, of a tip that leans, are not that much above.
        aside = np.linalg.norm(up - height[:, None] * facing, axis=1)
        over = (height > np.maximum(_STEEPEST * aside, _LEAST_OVER_M)) & (aside < _JUTS_OUT_M)
        if not over.any():
            return i
        # Nearest with an inner point, or with an end with which its neighbour is nearest, too.
        same = np.abs(away[near, None] - away[None, near]).max(axis=2) < _SAME_M
        over &= ((t[near] > 0.0) & (t[near] < 1.0)) | (same.sum(axis=1) > 1)
        return int(near[np.argmax(np.where(over, height, -np.inf))]) if over.any() else i

    def _outwards_at(self, vertex: Array, facing: Array) -> Array:
        ends = (np.abs(self.starts - vertex).max(axis=1) < _SAME_M) | (np.abs(self.ends - vertex).max(axis=1) < _SAME_M)
        normals, sides = self.middle_normals[ends], self._side[ends]
        towards = normals @ facing
        over = towards.argmax(axis=1)
        seen = towards.max(axis=1) >= _FACING_COS
        rows = np.arange(len(over))
        # Faces lie to the left of their own edges; the second face has the edge the other way round.
        outs = np.cross(sides, normals[rows, over]) * np.where(over == 0, 1.0, -1.0)[:, None]
        outs /= np.linalg.norm(outs, axis=1, keepdims=True)
        total: Array = outs[seen].sum(axis=0)
        return total


def _dot(a: Array, b: Array) -> Array:
    """Return (k,) the products of vectors (3, k), or of them with one (3,)."""
    product: Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


_SAME_M = 1e-9
_JUTS_OUT_M = 3e-3
_LEAST_OVER_M = 0.1e-3
_STEEPEST = 0.8
"""Height over distance aside that a lean of the tip brings about, at most: 39 deg."""
_FARTHEST_OVER_M = 8e-3
"""Tips are pressed in by less."""
_FACING_COS = 0.5
_CORNER_COS = np.cos(np.radians(35.0))


def creases(smooth: SmoothMesh) -> Polylines:
    """Return the creases and borders of a mesh. Pieces that bend by less than 35 deg get the tangents of a curve."""
    mesh = smooth.mesh
    face, edge = np.nonzero(smooth.neighbours < 0)
    start, end = mesh.faces[face, edge], mesh.faces[face, (edge + 1) % 3]
    normals = np.stack([smooth.normals[face, edge], smooth.normals[face, (edge + 1) % 3]], axis=1)
    # Each crease has two faces, each of which has it as an edge of its own, in the other direction.
    key = np.minimum(start, end).astype(np.int64) * len(mesh.vertices) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    one, two = order[first], order[first + np.minimum(count, 2) - 1]
    back = np.where((start[one] == start[two])[:, None, None], normals[two], normals[two][:, ::-1])
    both = np.stack([normals[one], back], axis=2)
    begin, finish = start[one], end[one]
    side = mesh.vertices[finish] - mesh.vertices[begin]
    unit = side / np.maximum(np.linalg.norm(side, axis=1), 1e-300)[:, None]
    return Polylines(
        mesh.vertices[begin], mesh.vertices[finish], both, _tangents(begin, finish, unit, len(mesh.vertices))
    )


def _tangents(begin: Indices, finish: Indices, unit: Array, vertex_count: int) -> Array:
    """Return (k, 2, 3) the tangent at both ends of each piece: the mean of both pieces where exactly two continue."""
    tangents = np.stack([unit, unit], axis=1)
    at = np.stack([begin, finish], axis=1).ravel()
    order = np.argsort(at, kind="stable")
    first = order[np.flatnonzero(np.bincount(at, minlength=vertex_count)[at[order]] == 2)].reshape(-1, 2)
    (one, other), (end, other_end) = (first // 2).T, (first % 2).T
    # A neighbour may run the other way round.
    along = np.where(end == other_end, -1.0, 1.0)[:, None] * unit[other]
    bends_little = np.einsum("kc,kc->k", along, unit[one]) >= _CORNER_COS
    one, other, end, other_end, along = (each[bends_little] for each in (one, other, end, other_end, along))
    mean = unit[one] + along
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    tangents[one, end] = mean
    tangents[other, other_end] = np.where(end == other_end, -1.0, 1.0)[:, None] * mean
    return tangents
