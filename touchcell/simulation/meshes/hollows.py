"""Where a tip does not fit, in hollows tighter than its radius and hollow creases, and where a mesh is too coarse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.smoothing import Edges, TriangleMesh, smooth

_LEAST_SHARE: Final = 0.002
_LEAST_CREASE_M: Final = 2e-3
_SLACK: Final = 0.95
_MOST_GUESSED_M: Final = 0.2e-3


@dataclass(frozen=True, slots=True)
class Hollows:
    """What of a mesh is too hollow for a tip, which rests on two sides there: its contact has no one depth and tilt.

    Attributes:
        share: of the area, hollow with a smaller radius than the tip's.
        tightest_m: smallest radius among it.
        crease_m: length of hollow creases.
        at: (3,) m, a place of either in the mesh's own frame; None where there is none.
    """

    share: float
    tightest_m: float
    crease_m: float
    at: Array | None

    @property
    def any(self) -> bool:
        """True if there is more of it than a few faces."""
        return self.share > _LEAST_SHARE or self.crease_m > _LEAST_CREASE_M


def hollows(mesh: TriangleMesh, crease_rad: float, tip_radius_m: float) -> Hollows:
    """Return what is too hollow for a tip of ``tip_radius_m``; edges sharper than ``crease_rad`` are creases."""
    made = smooth(mesh, crease_rad)
    xx, yy, zz, xy, xz, yz = made.bends.mean(axis=1).T
    half = 0.5 * (xx + yy + zz)
    minors = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
    least = half - np.sqrt(np.maximum(half * half - minors, 0.0))
    doubled = mesh.face_normals()
    area = np.linalg.norm(doubled, axis=1)
    tight = least < -1.0 / (_SLACK * tip_radius_m)

    corners = mesh.vertices[mesh.faces]
    other = Edges.of(mesh.faces).other
    # Two faces meet in a hollow where the other one's far corner is above this one.
    above = np.einsum("mec,mc->me", corners.mean(axis=1)[other] - corners[:, [0, 1, 2]], doubled) > 0.0
    creased = (other >= 0) & (made.neighbours < 0) & above
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    share = float(area[tight].sum() / max(area.sum(), 1e-300))
    at = None
    if tight.any():
        at = corners[int(np.argmax(np.where(tight, area, -1.0)))].mean(axis=0)
    elif creased.any():
        face, edge = np.unravel_index(int(np.argmax(np.where(creased, length, -1.0))), creased.shape)
        at = 0.5 * (corners[face, edge] + corners[face, (edge + 1) % 3])
    tightest_m = float(-1.0 / least[tight].min()) if tight.any() else float("inf")
    return Hollows(share, tightest_m, 0.5 * float(length[creased].sum()), at)


@dataclass(frozen=True, slots=True)
class Guessed:
    """What of a mesh is a guess: how far it bends between corners that are far apart.

    Attributes:
        share: of the area, of faces with an edge over whose middle the surface is guessed to be more than 0.2 mm off.
        most_m: the largest such distance.
        longest_m: longest of these edges.
        at: (3,) m, the middle of the edge with the largest distance, in the mesh's own frame.
    """

    share: float
    most_m: float
    longest_m: float
    at: Array


def guessed(mesh: TriangleMesh, crease_rad: float) -> Guessed:
    """Return what the smoothing of a mesh guesses; edges sharper than ``crease_rad`` are creases."""
    made = smooth(mesh, crease_rad)
    corners = mesh.vertices[mesh.faces]
    sides = np.roll(corners, -1, axis=1) - corners
    turns = np.roll(made.normals, -1, axis=1) - made.normals
    off_m = np.where(made.neighbours >= 0, np.abs(np.einsum("mec,mec->me", turns, sides)) / 8.0, 0.0)
    area = np.linalg.norm(mesh.face_normals(), axis=1)
    far = off_m > _MOST_GUESSED_M
    face, edge = np.unravel_index(int(np.argmax(off_m)), off_m.shape)
    return Guessed(
        float(area[far.any(axis=1)].sum() / max(area.sum(), 1e-300)),
        float(off_m.max()),
        float(np.linalg.norm(sides, axis=2)[far].max(initial=0.0)),
        corners[face, edge] + 0.5 * sides[face, edge],
    )
