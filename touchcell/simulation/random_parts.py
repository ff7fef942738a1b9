"""Random parts with a sharp edge: flat or curved faces, straight, curved and cornered outlines, rims of holes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.meshes.primitives import grid_faces
from touchcell.simulation.meshes.smoothing import Indices, TriangleMesh

_WALL_M: Final = 25e-3
_INWARDS_M: Final = (0.0, 2e-3, 5e-3, 9e-3, 14e-3, 20e-3, 28e-3, 40e-3)
_OUTER: Final = 0.85
_HOLES: Final = 0.3
_LEANING: Final = 0.75
_BLUNTEST_RAD: Final = math.radians(50.0)
_SHARPEST_RAD: Final = math.radians(40.0)
_DOWN_M: Final = (3e-3, 7e-3, 12e-3, 18e-3, _WALL_M)
_WALL_PER_M: Final = 45.0
_PLAIN: Final = 0.2
_STEEP_BLUNTEST_RAD: Final = math.radians(60.0)
_STEEP_WALL_PER_M: Final = 60.0
_NARROWEST: Final = 0.15
"""Size of a part's foot, as a share of its face, about."""
_SHEETS: Final = 0.25
_SHEET_M: Final = (3e-3, 8e-3)
_UNDERSIDE_M: Final = (5e-3, 12e-3, 25e-3)
_RINGS: Final = 0.1
_RING_M: Final = (4e-3, 12e-3)
_FLAT: Final = 0.25
_BENT: Final = 0.6
_DIFFERENCE_M: Final = 1e-6
_STEEP_HOLES: Final = 0.45
_STEEP_FLAT: Final = 0.3
_STEEP_BENT: Final = 0.6
_STEEP_CURVATURE_PER_M: Final = (6.0, 36.0)
_STEEP_WAVES_PER_M: Final = (70.0, 135.0)
_STEEP_SHARE: Final = (1.0, 2.8)
_SHARPEST_CURVATURE_PER_M: Final = 36.0
_STEEPEST_WAVE: Final = 0.35
_WAVES_PER_M: Final = (45.0, 130.0)


def steep_part(rng: np.random.Generator) -> TriangleMesh:
    """Return a part of what is rare among random ones: leaning, bent walls, and faces that bend tightly both ways.

    Between a third and a quarter of the faces are flat, as beside the rim of a bowl; outlines have few corners.
    """
    hole = bool(rng.random() < _STEEP_HOLES)
    outline = _outline(rng, hole=hole, kind=rng.uniform(0.12, 0.6))
    lean = rng.uniform(-_STEEP_BLUNTEST_RAD, _SHARPEST_RAD)
    wall_per_m = rng.uniform(-_STEEP_WALL_PER_M, _STEEP_WALL_PER_M)
    sheet_m = rng.uniform(*_SHEET_M) if rng.random() < _SHEETS else None
    middle = outline[rng.integers(len(outline))]
    return _part(outline, middle, _steep_heights(rng), lean, wall_per_m, sheet_m, None, hole=hole, exact=True)


def _steep_heights(rng: np.random.Generator) -> Callable[[Array], Array]:
    kind, turns = rng.random(), rng.uniform(0.0, math.pi, 2)
    if kind < _STEEP_FLAT:
        return _flat
    if kind < _STEEP_BENT:
        curvature = rng.uniform(*_STEEP_CURVATURE_PER_M, 2) * rng.choice([-1.0, 1.0], 2)
        return _bent(turns[0], curvature)
    # Two alike across each other, as in an egg box.
    per_m = rng.uniform(*_STEEP_WAVES_PER_M)
    across = np.array([turns[0], turns[0] + 0.5 * math.pi])
    share = np.full(2, rng.uniform(*_STEEP_SHARE)) * rng.uniform(0.8, 1.0, 2)
    return _waves(across, np.full(2, per_m), share, rng.uniform(0.0, 2.0 * math.pi, 2))


def random_part(rng: np.random.Generator) -> TriangleMesh:
    """Return a part whose rim is an edge between a face above and a wall below; its face looks towards +z.

    One in five is as most that are made: a flat face and upright walls. Of the rest
    a quarter of the faces are flat, the others bend both ways or are waves, with radii down to 28 mm, so that rims lead
    through space. Three quarters of the walls lean, so that they meet a face at 50 to 140 deg, and most of these bend,
    as a bowl's do. Outlines are circles, waves round a circle, drops with one sharp end, polygons and stars; three in
    ten are the rims of holes. A quarter are sheets 3 to 8 mm thick, a tenth are rings no wider than 12 mm, like the
    rim of a cup.
    """
    hole = bool(rng.random() < _HOLES)
    outline = _outline(rng, hole=hole, kind=rng.random())
    if rng.random() < _PLAIN:
        return _part(outline, outline[0], _flat, 0.0, 0.0, None, None, hole=hole)
    heights = _random_heights(rng)
    # Walls that lean under the face are as sharp as those of thin plates; blunt ones are those of bowls.
    lean = rng.uniform(-_BLUNTEST_RAD, _SHARPEST_RAD) * (rng.random() < _LEANING)
    wall_per_m = rng.uniform(-_WALL_PER_M, _WALL_PER_M) * (lean != 0.0 and rng.random() < 0.6)
    middle = outline[rng.integers(len(outline))]
    kind = rng.random()
    sheet_m = rng.uniform(*_SHEET_M) if kind < _SHEETS else None
    ring_m = rng.uniform(*_RING_M) if kind > 1.0 - _RINGS else None
    return _part(outline, middle, heights, lean, wall_per_m, sheet_m, ring_m, hole=hole)


def _part(
    outline: Array,
    middle: Array,
    heights: Callable[[Array], Array],
    lean: float,
    wall_per_m: float,
    sheet_m: float | None,
    ring_m: float | None,
    *,
    hole: bool,
    exact: bool = False,
) -> TriangleMesh:
    """Return the part with a rim over ``outline`` (n, 2) m, whose face bends about ``middle`` (2,) m.

    Its wall leans by ``lean`` rad under the face and bends; it is a sheet or a ring of so many metres, if any. With
    ``exact`` the mesh is told the normals of its face: facets of 5 mm tell those of a tight bend to 3 deg only.
    """
    length = np.linalg.norm(outline, axis=1, keepdims=True)

    def beside(offsets_m: Array) -> Array:
        """Return the outline moved to the side where the face is: rows (k, n, 2) m."""
        share = (1.0 if hole else -1.0) * offsets_m[:, None, None] / length
        # Never through the middle, and no two rows in one place.
        scale: Array = np.where(share < 0.0, np.maximum(1.0 + share, _NARROWEST * np.exp(share)), 1.0 + share)
        return outline * scale

    def on_face(rows: Array) -> Array:
        # Bent about a point of the rim, so that it stays a height over the plane however large the part is.
        return np.concatenate([rows, heights(rows - middle)[..., None]], axis=2)

    inwards = np.array(_INWARDS_M)
    if ring_m is not None:
        face = on_face(beside(np.linspace(0.0, ring_m, 4)))
    elif hole:
        face = on_face(beside(inwards))
    else:
        face = on_face(outline * (1.0 - inwards / max(float(length.max()), inwards[-1] / _OUTER))[:, None, None])
    down = np.array(_DOWN_M) if sheet_m is None else sheet_m * np.array([0.5, 1.0])
    under = np.tan(lean) * down + 0.5 * wall_per_m * down**2
    rows = [np.concatenate([beside(under), face[:1, :, 2:] - down[:, None, None]], axis=2)[::-1], face]
    if sheet_m is not None:
        rows.insert(0, (on_face(beside(under[-1] + np.array(_UNDERSIDE_M))) - [0.0, 0.0, sheet_m])[::-1])
    open_inside = hole or ring_m is not None
    if open_inside:
        rows.append(face[-1] - np.array([[[0.0, 0.0, _WALL_M]]]))
    grid = np.concatenate(rows)
    vertices, faces = grid.reshape(-1, 3), grid_faces(len(grid), len(outline), closed=True)
    if hole:
        faces = np.ascontiguousarray(faces[:, ::-1])
    first = len(rows[0]) + (0 if sheet_m is None else len(rows[1]))
    of_face = np.full((len(vertices), 3), np.nan)
    on = slice(first * len(outline), (first + len(face)) * len(outline))
    of_face[on] = _normals(heights, vertices[on, :2] - middle)
    if open_inside:
        return TriangleMesh(vertices, faces, _told(of_face, faces) if exact else None)
    count = len(outline)
    here, there = np.arange(count), (np.arange(count) + 1) % count
    vertices = np.concatenate([vertices, [[0.0, 0.0, float(heights(-middle))]]])
    last = (len(grid) - 1) * count
    lid = np.stack([np.full(count, len(vertices) - 1), last + here, last + there], axis=1)
    of_face = np.concatenate([of_face, _normals(heights, -middle[None])])
    faces = np.concatenate([faces, lid]).astype(np.int32)
    return TriangleMesh(vertices, faces, _told(of_face, faces) if exact else None)


def _normals(heights: Callable[[Array], Array], points: Array) -> Array:
    """Return (n, 3) upward unit normals at points (n, 2) m."""
    steps = _DIFFERENCE_M * np.eye(2)
    slopes = [(heights(points + step) - heights(points - step)) / (2.0 * _DIFFERENCE_M) for step in steps]
    normals: Array = np.stack([-slopes[0], -slopes[1], np.ones(len(points))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals


def _told(of_vertices: Array, faces: Indices) -> Array:
    """Return (m, 3, 3) normals at the corners of triangles that lie on the face, NaN for the others."""
    corners: Array = of_vertices[faces]
    corners[~np.isfinite(corners).all(axis=(1, 2))] = np.nan
    return corners


def _outline(rng: np.random.Generator, *, hole: bool, kind: float) -> Array:
    """Return (n, 2) m, counter-clockwise and seen whole from the origin."""
    smallest = 24e-3 if hole else 16e-3
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
    if kind > 0.8:
        return _star(rng, smallest)
    corners = int(rng.integers(3, 9))
    angle = (np.arange(corners) + rng.uniform(-0.25, 0.25, corners)) * 2.0 * math.pi / corners
    mean = rng.uniform(1.5 * smallest, 0.12) if kind < 0.74 else 0.2
    radius = mean * rng.uniform(0.7 if corners > 4 else 0.85, 1.0, corners)
    return _sides(radius, angle)


def _star(rng: np.random.Generator, smallest: float) -> Array:
    """Return an outline (n, 2) m whose corners point outwards and inwards by turns."""
    points = int(rng.integers(2, 7))
    angle = (np.arange(2 * points) + rng.uniform(-0.2, 0.2, 2 * points)) * math.pi / points
    mean = rng.uniform(2.0 * smallest, 0.1)
    return _sides(mean * np.where(np.arange(2 * points) % 2, rng.uniform(0.5, 0.85), 1.0), angle)


def _sides(radius: Array, angle: Array) -> Array:
    """Return points (n, 2) m along the straight sides between corners in polar coordinates."""
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    share = np.linspace(0.0, 1.0, 240 // len(points), endpoint=False)[:, None]
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


def _random_heights(rng: np.random.Generator) -> Callable[[Array], Array]:
    """Return a function of points (..., 2) m that gives the height (...) m of a face over the plane at each."""
    kind, turns = rng.random(), rng.uniform(0.0, math.pi, 2)
    if kind < _FLAT:
        return _flat
    if kind < _BENT:
        return _bent(turns[0], rng.uniform(-_SHARPEST_CURVATURE_PER_M, _SHARPEST_CURVATURE_PER_M, 2))
    return random_waves(rng, turns)


def _flat(points: Array) -> Array:
    return np.zeros(points.shape[:-1])


def _bent(turn: float, curvature_per_m: Array) -> Callable[[Array], Array]:
    """Return the heights of two bends across each other, the first along ``turn`` rad."""
    ways = _directions(turn + np.array([0.0, 0.5 * math.pi]))
    return lambda points: 0.5 * _bounded(points @ ways) @ curvature_per_m


def random_waves(rng: np.random.Generator, turns: Array) -> Callable[[Array], Array]:
    """Return a function of points (..., 2) m that gives the height (...) m of two waves, along both ``turns`` (2,) rad.

    Where they are tightest, radii are down to 14 mm where both add up and 28 mm along each.
    """
    per_m, share = rng.uniform(*_WAVES_PER_M, 2), rng.uniform(0.0, 2.0, 2)
    return _waves(turns, per_m, share, rng.uniform(0.0, 2.0 * math.pi, 2))


def _waves(turns: Array, per_m: Array, share: Array, phase: Array) -> Callable[[Array], Array]:
    highest_m = np.minimum(0.5 * _SHARPEST_CURVATURE_PER_M / per_m**2, 0.5 * _STEEPEST_WAVE / per_m)
    amplitude_m = share * highest_m
    waves = per_m * _directions(turns)
    return lambda points: np.cos(points @ waves + phase) @ amplitude_m


def _directions(angles: Array) -> Array:
    """Return (2, n): a unit vector in the plane for each angle."""
    return np.stack([np.cos(angles), np.sin(angles)])


def _bounded(x: Array) -> Array:
    """Return x^2 near zero, and no steeper than at 30 mm far away."""
    far = 30e-3
    return np.where(np.abs(x) < far, x * x, 2.0 * far * np.abs(x) - far * far)
