"""Random parts with a sharp edge: flat or curved faces, straight, curved and cornered outlines, rims of holes."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.primitives import grid_faces
from touchcell.simulation.meshes.smoothing import TriangleMesh

_WALL_M: Final = 25e-3
_INWARDS: Final = (1.0, 0.96, 0.9, 0.8, 0.65, 0.45, 0.2)
_OUTWARDS_M: Final = (0.0, 3e-3, 8e-3, 15e-3, 25e-3, 40e-3)
_BLUNTEST_RAD: Final = math.radians(45.0)
_NARROWEST: Final = 0.15
"""Size of a part's foot, as a share of its face."""
_SHARPEST_CURVATURE_PER_M: Final = 30.0


def random_part(rng: np.random.Generator) -> TriangleMesh:
    """Return a part whose rim is an edge between a face above and a wall below; its face looks towards +z.

    Half of the faces are flat, the others bend both ways with radii down to 33 mm. Two in five walls lean, by up to
    45 deg. Outlines are circles, waves round a circle, drops with one sharp end and polygons, stars among them; a
    quarter are the rims of holes.
    """
    hole = bool(rng.random() < 0.25)
    outline = _outline(rng, hole=hole)
    curvature = rng.uniform(-_SHARPEST_CURVATURE_PER_M, _SHARPEST_CURVATURE_PER_M, 2) * (rng.random() < 0.5)
    turn = rng.uniform(0.0, math.pi)
    # Walls that lean under the face are as sharp as those of thin plates; blunt ones are those of bowls.
    lean = rng.uniform(-_BLUNTEST_RAD, _BLUNTEST_RAD) * (rng.random() < 0.4)
    length = np.linalg.norm(outline, axis=1, keepdims=True)
    middle = outline[rng.integers(len(outline))]
    if hole:
        rings = np.stack([outline * (1.0 + away / length) for away in _OUTWARDS_M])
        wall = outline * np.maximum(1.0 + math.tan(lean) * _WALL_M / length, _NARROWEST)
    else:
        rings = np.stack([outline * share for share in _INWARDS])
        wall = outline * np.maximum(1.0 - math.tan(lean) * _WALL_M / length, _NARROWEST)
    # Bent about a point of the rim, so that it stays a height over the plane however large the part is.
    face = np.concatenate([rings, _heights(rings - middle, curvature, turn)[..., None]], axis=2)
    foot = np.concatenate([wall, face[0, :, 2:] - _WALL_M], axis=1)
    count, rows = len(outline), len(face) + 1
    vertices = np.concatenate([foot[None], face]).reshape(-1, 3)
    faces = grid_faces(rows, count, closed=True)
    if hole:
        return TriangleMesh(vertices, np.ascontiguousarray(faces[:, ::-1]))
    here, there = np.arange(count), (np.arange(count) + 1) % count
    centre_z = float(_heights(-middle, curvature, turn))
    vertices = np.concatenate([vertices, [[0.0, 0.0, centre_z]]])
    last = (rows - 1) * count
    lid = np.stack([np.full(count, len(vertices) - 1), last + here, last + there], axis=1)
    return TriangleMesh(vertices, np.concatenate([faces, lid]).astype(np.int32))


def _outline(rng: np.random.Generator, *, hole: bool) -> Array:
    """Return (n, 2) m, counter-clockwise and seen whole from the origin."""
    smallest = 24e-3 if hole else 16e-3
    kind = rng.random()
    if kind < 0.12 and not hole:
        return _drop(rng)
    if kind < 0.5:
        angle = np.arange(240) * 2.0 * math.pi / 240
        mean = math.exp(rng.uniform(math.log(1.1 * smallest), math.log(0.2)))
        waves = int(rng.integers(2, 6))
        # Curvature at the crest of a wave is (1 + share (waves^2 + 1)) / mean, to first order.
        most = min((mean / smallest - 1.0) / (waves**2 + 1.0), 0.25)
        radius = mean * (1.0 + rng.uniform(0.0, max(most, 0.0)) * np.cos(waves * angle + rng.uniform(0.0, 6.3)))
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    corners = int(rng.integers(3, 9))
    angle = (np.arange(corners) + rng.uniform(-0.25, 0.25, corners)) * 2.0 * math.pi / corners
    mean = rng.uniform(1.5 * smallest, 0.12) if kind < 0.85 else 0.2
    radius = mean * rng.uniform(0.7 if corners > 4 else 0.85, 1.0, corners)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    share = np.linspace(0.0, 1.0, 240 // corners, endpoint=False)[:, None]
    return np.concatenate(
        [(1.0 - share) * a + share * b for a, b in zip(points, np.roll(points, -1, axis=0), strict=True)]
    )


def _drop(rng: np.random.Generator) -> Array:
    """Return an outline (n, 2) m like that of a wing: round at one end, sharp at the other, seen whole from within."""
    angle = np.arange(240) * 2.0 * math.pi / 240
    half, thickness, sharpness = rng.uniform(30e-3, 80e-3), rng.uniform(0.2, 0.6), rng.uniform(0.7, 1.6)
    wide = thickness * np.sin(angle) * np.sin(0.5 * angle) ** sharpness
    outline = half * np.stack([np.cos(angle) + 0.3, wide], axis=1)
    turn = rng.uniform(0.0, 2.0 * math.pi)
    sin, cos = math.sin(turn), math.cos(turn)
    drop: Array = outline @ np.array([[cos, sin], [-sin, cos]])
    return drop


def _heights(points: Array, curvature: Array, turn: float) -> Array:
    sin, cos = math.sin(turn), math.cos(turn)
    x, y = cos * points[..., 0] + sin * points[..., 1], cos * points[..., 1] - sin * points[..., 0]
    heights: Array = 0.5 * (_bounded(x) * curvature[0] + _bounded(y) * curvature[1])
    return heights


def _bounded(x: Array) -> Array:
    """Return x^2 near zero, and no steeper than at 30 mm far away."""
    far = 30e-3
    return np.where(np.abs(x) < far, x * x, 2.0 * far * np.abs(x) - far * far)
