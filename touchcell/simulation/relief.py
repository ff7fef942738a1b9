"""What a tip feels of a surface besides its tangent plane.

The deformation of the skin on a plane is calibrated on real images (``tip.py``). Of another shape it is that of the
tangent plane, plus what the difference adds: at samples of the skin, how much deeper the surface reaches into the
undeformed sphere than its tangent plane does, spread over the skin by a kernel as wide as its bending stiffness lets
it bend. On a plane the difference is zero and nothing changes.
"""

from __future__ import annotations

import math
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.simulation.surfaces import Plane, Shape, Surface

_RINGS: Final = 6
_STEP_RAD: Final = math.radians(11.0)
_WIDTH_RAD: Final = math.radians(11.0)
_REACH_M: Final = 6e-3
"""Skin further than this above the tangent plane is not asked about: it touches in narrow hollows only."""
_THIN: Final = 0.98
"""Share of its depth below the tangent plane, below which skin may have come through a wall."""
_OTHER_SIDE_COS: Final = -0.3
_SIDEWAYS_COS: Final = 0.7
"""Above it a surface is seen from the side of the touched one."""
_BESIDE_M: Final = 0.2e-3
_OVER: Final = np.array([0.4, 0.75, 0.96])
"""Where between a wall and the tangent plane there may be what covers it."""
_ACROSS_M: Final = 8e-3
_UPRIGHT: Final = 0.3
_CLEAR_M: Final = 1e-3


@runtime_checkable
class ManyDistances(Protocol):
    """A shape that finds the distances of many points at once."""

    def distances(self, points: Array) -> Array:
        """Return the (k,) signed distances of ``points`` (k, 3) m."""
        ...


class ReliefKernel:
    """Samples of the skin, and how markers follow what is felt there.

    Args:
        directions: (markers, 3) unit vectors from the sphere's centre to the markers.
    """

    def __init__(self, directions: Array) -> None:
        ring = np.concatenate([np.full(max(6 * k, 1), k) for k in range(_RINGS + 1)])
        azimuth = np.concatenate([np.arange(max(6 * k, 1)) * 2.0 * np.pi / max(6 * k, 1) for k in range(_RINGS + 1)])
        polar = _STEP_RAD * ring
        self.directions = np.stack(
            [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1
        )
        cos = np.clip(directions @ self.directions.T, -1.0, 1.0)
        angle = np.arccos(cos)
        kernel = np.exp(-((angle / _WIDTH_RAD) ** 2))
        # The gradient of exp(-(angle / width)^2) along the sphere leads towards the sample.
        steep = kernel * 2.0 / _WIDTH_RAD**2 * np.where(angle > 1e-6, angle / np.maximum(np.sin(angle), 1e-9), 1.0)
        towards = self.directions[None] - cos[..., None] * directions[:, None]
        gradient = steep[..., None] * towards
        # Outside the samples nothing is felt: there the kernel's sum is filled up by zeros.
        total = np.maximum(kernel.sum(axis=1), 0.5 * kernel.sum(axis=1).max())[:, None]
        self._weights = kernel / total
        self._slopes = np.ascontiguousarray(
            ((gradient - self._weights[..., None] * gradient.sum(axis=1)[:, None]) / total[..., None]).transpose(
                0, 2, 1
            )
        )

    def values(self, felt: Array) -> Array:
        """Return (..., markers) of values ``felt`` (..., samples)."""
        values: Array = felt @ self._weights.T
        return values

    def slopes(self, felt: Array) -> Array:
        """Return (..., markers, 3) their gradient along the sphere, per radian."""
        slopes: Array = np.einsum("mck,...k->...mc", self._slopes, felt)
        return slopes


def mirrored_samples() -> NDArray[np.int64]:
    """Return which sample is the image of each in a mirror at the sensor's xz plane."""
    counts = [max(6 * k, 1) for k in range(_RINGS + 1)]
    return np.concatenate([sum(counts[:k]) + (-np.arange(count)) % count for k, count in enumerate(counts)])


def felt_relief(surface: Surface, T_world_s: Array, t_s: float, directions: Array, tip_radius_m: float) -> Array | None:
    """Return (samples,) m: how much further than its tangent plane a surface presses into the undeformed tip.

    Args:
        surface: the surface that is touched.
        T_world_s: (4, 4) pose of the sensor.
        t_s: time of the scene.
        directions: (samples, 3) of the skin, in the sensor frame.
        tip_radius_m: radius of the tip.

    Returns:
        None where a plane is touched, or nothing.
    """
    shape = surface.shape
    if isinstance(shape, Plane):
        return None
    T_world_b = surface.motion.pose(t_s)
    R_b_s = T_world_b[:3, :3].T @ T_world_s[:3, :3]
    centre = T_world_b[:3, :3].T @ (T_world_s[:3, 3] - T_world_b[:3, 3])
    nearest = shape.nearest(centre)
    if nearest.distance_m >= tip_radius_m:
        return None
    points = centre + tip_radius_m * directions @ R_b_s.T
    above = (points - nearest.point) @ nearest.normal
    asked = above < _REACH_M
    distances = np.full(len(points), np.inf)
    distances[asked] = _distances(shape, points[asked])
    pressed_in = np.maximum(-distances, 0.0)
    # Of a wall that is thinner than the tip presses in, the nearest surface is often one that the tip cannot come to.
    below = np.flatnonzero(pressed_in < _THIN * -above)
    if len(below):
        pressed_in[below] = _from_outside(shape, nearest, points[below], pressed_in[below])
    relief: Array = pressed_in - np.maximum(-above, 0.0)
    return relief


def _from_outside(shape: Shape, touched: SurfacePoint, points: Array, pressed_in: Array) -> Array:
    """Return (k,) m how far ``points`` (k, 3) are pressed in, from surfaces that can be come to from outside.

    Others are the far side of a wall, and walls of a hollow with the touched face over them.

    Args:
        shape: what is touched.
        touched: its point that is nearest to the tip's centre.
        points: of the undeformed skin, below the tangent plane.
        pressed_in: (k,) m distance to any surface.
    """
    normal = touched.normal
    near = [shape.nearest(p) for p in points]
    normals, places = np.array([each.normal for each in near]), np.array([each.point for each in near])
    facing = normals @ normal
    hidden = facing < _OTHER_SIDE_COS
    sideways = np.flatnonzero(~hidden & (facing < _SIDEWAYS_COS))
    if len(sideways):
        beside = places[sideways] + _BESIDE_M * normals[sideways]
        over_m = (touched.point - beside) @ normal
        # A wall that leans outwards is covered near by; a hollow, which may be felt through a face, farther off, too.
        outwards = normals[sideways] - facing[sideways, None] * normal
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9)
        farther = beside + (over_m[:, None] + _CLEAR_M) * outwards
        over = farther[:, None] + (over_m[:, None] * _OVER)[..., None] * normal
        covered = (_distances(shape, over.reshape(-1, 3)).reshape(len(sideways), -1) < 0.0).any(axis=1)
        hidden[sideways[covered & (over_m > 0.0)]] = True
    which = np.flatnonzero(hidden)
    if not len(which):
        return pressed_in
    found = pressed_in.copy()
    p = points[which]
    outside_m = (touched.point - p) @ normal + _CLEAR_M
    from_above = outside_m - _distances(shape, p + outside_m[:, None] * normal)
    # The part ends aside: beyond a wall that stands upright, or towards or away from the touched point.
    ways = np.stack([-normals[which], p - touched.point, touched.point - p])
    ways -= (ways @ normal)[..., None] * normal
    length = np.linalg.norm(ways, axis=2)
    ways *= (_ACROSS_M / np.maximum(length, 1e-9))[..., None]
    across = _distances(shape, (p + ways).reshape(-1, 3)).reshape(3, -1)
    known = (across > 0.0) & (length > np.array([_UPRIGHT, _BESIDE_M, _BESIDE_M])[:, None])
    # Not of a wall that leans back under its edge: networks are taught that it is felt from above.
    known &= (facing[which] < -_SIDEWAYS_COS) | (facing[which] >= _OTHER_SIDE_COS)
    from_aside = np.where(known, _ACROSS_M - across, np.inf)
    best = from_aside.argmin(axis=0)
    found[which] = from_above
    # Straight to the outer face that was found so.
    ends = np.flatnonzero(known.any(axis=0))
    if len(ends):
        outer = np.array([shape.nearest(p[i] + ways[best[i], i]).normal for i in ends])
        outer -= (outer @ normal)[:, None] * normal
        outer *= (_ACROSS_M / np.maximum(np.linalg.norm(outer, axis=1), 1e-9))[:, None]
        straight = _distances(shape, p[ends] + outer)
        aside = np.where(straight > 0.0, _ACROSS_M - straight, from_aside[best[ends], ends])
        found[which[ends]] = np.minimum(from_above[ends], aside)
    found[which] = np.maximum(found[which], 0.0)
    return found


def _distances(shape: Shape, points: Array) -> Array:
    if isinstance(shape, ManyDistances):
        return shape.distances(points)
    return np.array([shape.nearest(p).distance_m for p in points])
