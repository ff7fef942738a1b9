"""Rigid surfaces in closed form: nearest point and outward normal.

A ``Shape`` is fixed in its own frame; a ``Surface`` is a shape that moves through the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from touchcell.errors import ConfigError
from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.simulation.meshes import primitives
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.motions import Motion, Still

_FLAT = (0.0, 0.0)


def _lengths(points: Array) -> Array:
    lengths: Array = np.sqrt(np.einsum("kc,kc->k", points, points))
    return lengths


class Shape(Protocol):
    """Outer surface of a rigid body, in the body's own frame."""

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m."""
        ...


@dataclass(frozen=True, slots=True)
class Plane:
    """The plane z = 0 with its outside towards +z."""

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m."""
        return SurfacePoint(float(p[2]), np.array([0.0, 0.0, 1.0]), np.array([p[0], p[1], 0.0]), _FLAT)


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball about the origin."""

    radius_m: float

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m; for the centre itself, the top."""
        length = math.sqrt(float(p @ p))
        normal = p / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
        curvature = 1.0 / self.radius_m
        return SurfacePoint(length - self.radius_m, normal, self.radius_m * normal, (curvature, curvature))

    def distances(self, points: Array) -> Array:
        """Return the (k,) signed distances of ``points`` (k, 3) m."""
        return _lengths(points) - self.radius_m

    def drawn(self) -> TriangleMesh:
        """Return the ball as a mesh."""
        return primitives.ball(self.radius_m)


@dataclass(frozen=True, slots=True)
class Dome:
    """A hemisphere about the origin that rises from the plane z = 0."""

    radius_m: float

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m; exact outside the body, where a tip's centre always is."""
        on_cap = Sphere(self.radius_m).nearest(p)
        return on_cap if on_cap.distance_m < p[2] else Plane().nearest(p)

    def distances(self, points: Array) -> Array:
        """Return the (k,) signed distances of ``points`` (k, 3) m."""
        return np.minimum(_lengths(points) - self.radius_m, points[:, 2])


@dataclass(frozen=True, slots=True)
class Ramp:
    """A flat that bends into an incline along +x over a circular arc; the same for every y.

    The profile is z = 0 for x <= 0, then an arc of ``bend_radius_m``, then a straight incline at ``incline_rad``:
    rising (a hollow bend) if positive, falling (a rounded edge) if negative. Its slope is continuous.
    """

    bend_radius_m: float
    incline_rad: float

    def __post_init__(self) -> None:
        if not 0.0 < abs(self.incline_rad) < math.pi / 2:
            raise ConfigError("must be between 0 and 90 deg", key="incline_rad", value=self.incline_rad)

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m; exact within ``bend_radius_m`` above the surface."""
        x, y, z = p.tolist()
        if x <= 0.0:
            return Plane().nearest(p)
        R, angle = self.bend_radius_m, self.incline_rad
        sign = math.copysign(1.0, angle)
        sin, cos = math.sin(angle), math.cos(angle)
        end_x, end_z = R * abs(sin), sign * R * (1.0 - cos)
        along = (x - end_x) * cos + (z - end_z) * sin
        if along >= 0.0:
            distance = (z - end_z) * cos - (x - end_x) * sin
            point = np.array([end_x + along * cos, y, end_z + along * sin])
            return SurfacePoint(distance, np.array([-sin, 0.0, cos]), point, _FLAT)
        # The arc's centre is above a hollow bend and below a rounded edge; outwards is towards it or away from it.
        from_centre = math.hypot(x, z - sign * R)
        normal = np.array([-sign * x / from_centre, 0.0, -sign * (z - sign * R) / from_centre])
        distance = sign * (R - from_centre)
        curvatures = (0.0, -1.0 / R) if sign > 0.0 else (1.0 / R, 0.0)
        return SurfacePoint(distance, normal, np.array([x, y, z]) - distance * normal, curvatures)


@dataclass(frozen=True, slots=True)
class Surface:
    """A shape in motion through the world.

    Attributes:
        shape: shape of the body.
        motion: prescribed motion; ``Still`` by default.
    """

    shape: Shape
    motion: Motion = field(default_factory=Still)

    def nearest(self, p_world: Array, t_s: float) -> SurfacePoint:
        """Return the nearest point at time ``t_s`` to ``p_world`` (3,) m, in the world frame."""
        T = self.motion.pose(t_s)
        R, origin = T[:3, :3], T[:3, 3]
        found = self.shape.nearest((p_world - origin) @ R)
        return SurfacePoint(found.distance_m, R @ found.normal, R @ found.point + origin, found.curvatures_per_m)
