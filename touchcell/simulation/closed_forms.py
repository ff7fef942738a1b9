"""Further rigid shapes in closed form: box, cylinder, saddle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.simulation.meshes import primitives
from touchcell.simulation.meshes.creases import Polylines, creases
from touchcell.simulation.meshes.smoothing import TriangleMesh, smooth

_CREASE_RAD = math.radians(30.0)


@lru_cache(maxsize=8)
def _edges(shape: Box | Cylinder) -> Polylines:
    return creases(smooth(shape.drawn(), _CREASE_RAD))


@dataclass(frozen=True, slots=True)
class Box:
    """A box that stands on z = 0 with its centre on the z axis.

    Attributes:
        size_m: along x, y and z.
    """

    size_m: tuple[float, float, float]

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m."""
        half = tuple(0.5 * size for size in self.size_m)
        q = (float(p[0]), float(p[1]), float(p[2]) - half[2])
        over = [abs(x) - h for x, h in zip(q, half, strict=True)]
        normal = [0.0, 0.0, 0.0]
        point = list(q)
        deepest = max(range(3), key=over.__getitem__)
        if over[deepest] <= 0.0:
            outside = [deepest]
            distance = over[deepest]
            normal[deepest] = math.copysign(1.0, q[deepest])
        else:
            outside = [i for i in range(3) if over[i] > 0.0]
            distance = math.sqrt(sum(over[i] ** 2 for i in outside))
            for i in outside:
                normal[i] = math.copysign(over[i], q[i]) / distance
        for i in outside:
            point[i] = math.copysign(half[i], q[i])
        point[2] += half[2]
        flat = (0.0, 0.0) if len(outside) == 1 else None
        return SurfacePoint(distance, np.array(normal), np.array(point), flat)

    def distances(self, points: Array) -> Array:
        """Return the (k,) signed distances of ``points`` (k, 3) m."""
        half = 0.5 * np.array(self.size_m)
        over = np.abs(points - np.array([0.0, 0.0, half[2]])) - half
        outside = np.maximum(over, 0.0)
        distances: Array = np.sqrt(np.einsum("kc,kc->k", outside, outside)) + np.minimum(over.max(axis=1), 0.0)
        return distances

    def drawn(self) -> TriangleMesh:
        """Return the box as a mesh."""
        return primitives.box(np.array(self.size_m))

    @property
    def edges(self) -> Polylines:
        """Its twelve edges."""
        return _edges(self)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about z that stands on z = 0."""

    radius_m: float
    height_m: float

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m; for a point of the axis, along x."""
        x, y, z = p.tolist()
        half = 0.5 * self.height_m
        rho = math.hypot(x, y)
        cos, sin = (x / rho, y / rho) if rho > 0.0 else (1.0, 0.0)
        up = math.copysign(1.0, z - half)
        aside, above = rho - self.radius_m, abs(z - half) - half
        end_z = half + up * half
        if aside > 0.0 and above > 0.0:
            distance = math.hypot(aside, above)
            normal = (cos * aside / distance, sin * aside / distance, up * above / distance)
            return SurfacePoint(distance, np.array(normal), np.array([self.radius_m * cos, self.radius_m * sin, end_z]))
        if above >= aside:
            return SurfacePoint(above, np.array([0.0, 0.0, up]), np.array([x, y, end_z]), (0.0, 0.0))
        point = np.array([self.radius_m * cos, self.radius_m * sin, z])
        return SurfacePoint(aside, np.array([cos, sin, 0.0]), point, (1.0 / self.radius_m, 0.0))

    def distances(self, points: Array) -> Array:
        """Return the (k,) signed distances of ``points`` (k, 3) m."""
        aside = np.hypot(points[:, 0], points[:, 1]) - self.radius_m
        above = np.abs(points[:, 2] - 0.5 * self.height_m) - 0.5 * self.height_m
        outside = np.hypot(np.maximum(aside, 0.0), np.maximum(above, 0.0))
        distances: Array = outside + np.minimum(np.maximum(aside, above), 0.0)
        return distances

    def drawn(self) -> TriangleMesh:
        """Return the cylinder as a mesh."""
        return primitives.cylinder(self.radius_m, self.height_m)

    @property
    def edges(self) -> Polylines:
        """Its two rims."""
        return _edges(self)


@dataclass(frozen=True, slots=True)
class Saddle:
    """The surface z = x^2 / (2 hollow) - y^2 / (2 ridge), without end: a valley along y, a ridge along x.

    Attributes:
        hollow_radius_m: radius of curvature of the section y = 0 at the origin, its centre above.
        ridge_radius_m: of the section x = 0, its centre below.
    """

    hollow_radius_m: float
    ridge_radius_m: float

    def nearest(self, p: Array) -> SurfacePoint:
        """Return the nearest surface point to ``p`` (3,) m; exact within the smaller radius of the surface."""
        px, py, pz = p.tolist()
        a, b = 1.0 / self.hollow_radius_m, -1.0 / self.ridge_radius_m
        x, y = px, py
        for _ in range(50):
            off = 0.5 * (a * x * x + b * y * y) - pz
            hx, hy = a * x, b * y
            fx, fy = x - px + off * hx, y - py + off * hy
            xx, yy, xy = 1.0 + hx * hx + off * a, 1.0 + hy * hy + off * b, hx * hy
            determinant = xx * yy - xy * xy
            if determinant <= 1e-9 or xx <= 0.0:
                # Beyond a centre of curvature: the convex part of the Hessian still leads downhill.
                xx, yy = 1.0 + hx * hx + abs(off * a), 1.0 + hy * hy + abs(off * b)
                determinant = xx * yy - xy * xy
            dx, dy = (yy * fx - xy * fy) / determinant, (xx * fy - xy * fx) / determinant
            x, y = x - dx, y - dy
            if abs(dx) + abs(dy) < 1e-12:
                break
        hx, hy = a * x, b * y
        length = math.sqrt(1.0 + hx * hx + hy * hy)
        normal = np.array([-hx, -hy, 1.0]) / length
        point = np.array([x, y, 0.5 * (a * x * x + b * y * y)])
        # Curvatures of a graph, with the sign of convexity: minus its second fundamental form.
        mean = -0.5 * ((1.0 + hy * hy) * a + (1.0 + hx * hx) * b) / length**3
        gauss = a * b / length**4
        root = math.sqrt(max(mean * mean - gauss, 0.0))
        return SurfacePoint(float((p - point) @ normal), normal, point, (mean + root, mean - root))
