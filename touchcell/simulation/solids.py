"""Geometry and mechanics of free objects: nearest surface point, inertia, friction moment on a table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.simulation.shapes import Ball, Prism, Solid, Turned
from touchcell.simulation.surfaces import Shape, Sphere


@dataclass(frozen=True, slots=True)
class MassProperties:
    """Mass properties of a solid of even density, in its own frame, whose axes are principal through the centre of
    mass.

    Attributes:
        com_m: (3,) centre of mass.
        inertia_per_kg_m2: (3,) principal moments over the mass.
    """

    com_m: Array
    inertia_per_kg_m2: Array


# Closer to a corner than this, rounding may decide which of two faces is nearer.
_CLEAR_M = 1e-5

Nearest = tuple[float, float, float, float, float, float, float]
"""Contents of a ``SurfacePoint`` as plain numbers: distance, normal x, y, z and point x, y, z."""


class PlainShape(Shape, Protocol):
    """A shape with nearest points in plain numbers: NumPy takes several times as long for so few."""

    def nearest_numbers(self, x: float, y: float, z: float) -> Nearest:
        """Return the nearest surface point to (x, y, z) m."""
        ...


def shape_of(solid: Solid) -> Shape:
    """Return the outer shape of the solid, in its own frame; exact for points outside."""
    return Sphere(solid.radius_m) if isinstance(solid, Ball) else plain_shape_of(solid)


def plain_shape_of(solid: Prism | Turned) -> PlainShape:
    """Return the same for an upright solid, in plain numbers."""
    if isinstance(solid, Prism):
        return _PrismShape(_sides(solid.outline_m), solid.height_m)
    return _TurnedShape(_sections(solid))


def mass_properties(solid: Solid) -> MassProperties:
    """Return centre of mass and moments of inertia at even density.

    A prism's outline must be symmetric about its axes; all outlines that a scene can describe are.
    """
    match solid:
        case Ball():
            return MassProperties(np.zeros(3), np.full(3, 0.4 * solid.radius_m**2))
        case Prism():
            xx, yy = _second_moments(solid.outline_m)
            along_z = solid.height_m**2 / 12.0
            moments = np.array([yy + along_z, xx + along_z, xx + yy])
            return MassProperties(np.array([0.0, 0.0, 0.5 * solid.height_m]), moments)
        case Turned():
            parts = [
                (radius**2 * (top - bottom), 0.5 * (top + bottom), top - bottom, radius)
                for bottom, top, radius in _sections(solid)
            ]
            total = sum(weight for weight, *_ in parts)
            z = sum(weight * middle for weight, middle, *_ in parts) / total
            across = sum(w * (r**2 / 4.0 + h**2 / 12.0 + (m - z) ** 2) for w, m, h, r in parts) / total
            about = sum(w * r**2 / 2.0 for w, _, _, r in parts) / total
            return MassProperties(np.array([0.0, 0.0, z]), np.array([across, across, about]))


def friction_radius_m(solid: Prism | Turned) -> float:
    """Return the lever arm of friction in rotation on the spot: the mean distance of the bottom from its centre.

    This holds for uniform pressure: 2 R / 3 for a disc and 0.3826 w for a square.
    """
    if isinstance(solid, Turned):
        return 2.0 / 3.0 * solid.sections_m[0][1]
    area = moment = 0.0
    for (ax, ay), (bx, by) in _edges(solid.outline_m):
        # In polar coordinates about the origin an edge at distance d is r = d / cos(angle - its normal's).
        length = math.hypot(bx - ax, by - ay)
        d = (ax * by - ay * bx) / length
        along_a, along_b = ((ax * (bx - ax) + ay * (by - ay)) / length, (bx * (bx - ax) + by * (by - ay)) / length)
        area += 0.5 * d * (along_b - along_a)
        moment += d / 3.0 * (_integral(along_b, d) - _integral(along_a, d))
    return moment / area


def supports_m(solid: Prism | Turned) -> tuple[tuple[float, float], ...]:
    """Return nine points (x, y) of a bottom, each with a ninth of the weight, that resist sliding as even pressure.

    They have the second moments of even pressure, and the lever arm of friction in rotation on the spot to 1 %. An
    off-centre push turns boxes by as much as even pressure within 3 %. On a box they are those of Chebyshev's rule with
    equal weights, on others a point and a ring, exact for a disc.
    """
    if isinstance(solid, Turned):
        xx = yy = 0.25 * solid.sections_m[0][1] ** 2
    else:
        xx, yy = _second_moments(solid.outline_m)
    if isinstance(solid, Prism) and len(solid.outline_m) == 4:
        x, y = math.sqrt(1.5 * xx), math.sqrt(1.5 * yy)
        return tuple((i * x, j * y) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0))
    x, y = 1.5 * math.sqrt(xx), 1.5 * math.sqrt(yy)
    angles = [2.0 * math.pi * (i + 0.5) / 8.0 for i in range(8)]
    return (0.0, 0.0), *((x * math.cos(angle), y * math.sin(angle)) for angle in angles)


def _integral(s: float, d: float) -> float:
    """Return the integral of sqrt(s^2 + d^2) over s."""
    r = math.hypot(s, d)
    return 0.5 * (s * r + d * d * math.asinh(s / d))


_Point = tuple[float, float]


def _edges(outline_m: Array) -> tuple[tuple[_Point, _Point], ...]:
    corners = [(float(x), float(y)) for x, y in outline_m]
    return tuple(zip(corners, [*corners[1:], corners[0]], strict=True))


def _sides(outline_m: Array) -> tuple[tuple[float, float, float, float, float], ...]:
    """Return (x, y) of each corner, unit vector (x, y) to the next, and the distance to it."""
    sides = []
    for (ax, ay), (bx, by) in _edges(outline_m):
        length = math.hypot(bx - ax, by - ay)
        sides.append((ax, ay, (bx - ax) / length, (by - ay) / length, length))
    return tuple(sides)


def _sections(solid: Turned) -> tuple[tuple[float, float, float], ...]:
    """Return (bottom, top, radius) of each section."""
    sections, bottom = [], 0.0
    for height, radius in solid.sections_m:
        sections.append((bottom, bottom + height, radius))
        bottom += height
    return tuple(sections)


def _second_moments(outline_m: Array) -> tuple[float, float]:
    """Return the mean of x^2 and of y^2 over the outline's area."""
    a, b = outline_m, np.roll(outline_m, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    xx, yy = (cross[:, None] * (a * a + a * b + b * b)).sum(axis=0) / (6.0 * cross.sum())
    return float(xx), float(yy)


@dataclass(frozen=True, slots=True)
class _PrismShape:
    sides: tuple[tuple[float, float, float, float, float], ...]
    height_m: float

    def nearest(self, p: Array) -> SurfacePoint:
        return _in_arrays(self.nearest_numbers(*p.tolist()))

    def nearest_numbers(self, x: float, y: float, z: float) -> Nearest:
        outside, best_sq, foot_x, foot_y = False, math.inf, 0.0, 0.0
        face_x, face_y = 1.0, 0.0
        deepest, out_x, out_y = -math.inf, 1.0, 0.0
        for ax, ay, tx, ty, length in self.sides:
            dx, dy = x - ax, y - ay
            beyond, along = dx * ty - dy * tx, dx * tx + dy * ty
            if beyond > 0.0:
                if _CLEAR_M < along < length - _CLEAR_M:
                    # In front of one face of a convex outline no other face is nearer.
                    px, py = ax + along * tx, ay + along * ty
                    distance = math.sqrt((x - px) ** 2 + (y - py) ** 2)
                    return _off_a_rim(z, px, py, ty, -tx, distance, self.height_m)
                outside = True
            if beyond > deepest:
                deepest, out_x, out_y = beyond, ty, -tx
            if 0.0 < along < length:
                # Near a face its normal is exact, while the direction to its nearest point is dominated by rounding.
                here_x, here_y = ty, -tx
            else:
                here_x, here_y = 0.0, 0.0
                along = 0.0 if along <= 0.0 else length
            px, py = ax + along * tx, ay + along * ty
            distance_sq = (x - px) ** 2 + (y - py) ** 2
            if distance_sq < best_sq:
                best_sq, foot_x, foot_y, face_x, face_y = distance_sq, px, py, here_x, here_y
        if outside:
            beyond = math.sqrt(best_sq)
            if face_x == 0.0 and face_y == 0.0:
                if beyond > 0.0:
                    face_x, face_y = (x - foot_x) / beyond, (y - foot_y) / beyond
                else:
                    face_x, face_y = out_x, out_y
            return _off_a_rim(z, foot_x, foot_y, face_x, face_y, beyond, self.height_m)
        over, under = z - self.height_m, -z
        if deepest >= max(over, under):
            return deepest, out_x, out_y, 0.0, x - deepest * out_x, y - deepest * out_y, z
        return _off_an_end(x, y, self.height_m, over, under)


@dataclass(frozen=True, slots=True)
class _TurnedShape:
    sections: tuple[tuple[float, float, float], ...]

    def nearest(self, p: Array) -> SurfacePoint:
        return _in_arrays(self.nearest_numbers(*p.tolist()))

    def nearest_numbers(self, x: float, y: float, z: float) -> Nearest:
        off_axis = math.hypot(x, y)
        ux, uy = (x / off_axis, y / off_axis) if off_axis > 0.0 else (1.0, 0.0)
        found: Nearest | None = None
        for bottom, top, radius in self.sections:
            beyond, height = off_axis - radius, top - bottom
            over, under = z - top, bottom - z
            if beyond > 0.0:
                here = _off_a_rim(z - bottom, ux * radius, uy * radius, ux, uy, beyond, height)
            elif beyond >= max(over, under):
                here = (beyond, ux, uy, 0.0, ux * radius, uy * radius, z - bottom)
            else:
                here = _off_an_end(x, y, height, over, under)
            if found is None or here[0] < found[0]:
                found = (*here[:6], here[6] + bottom)
        assert found is not None
        return found


def _in_arrays(found: Nearest) -> SurfacePoint:
    distance, nx, ny, nz, px, py, pz = found
    return SurfacePoint(distance, np.array([nx, ny, nz]), np.array([px, py, pz]))


def _off_a_rim(
    z: float, foot_x: float, foot_y: float, out_x: float, out_y: float, beyond: float, height: float
) -> Nearest:
    """Return the nearest point to one ``beyond`` the outline along unit vector ``out`` from its nearest ``foot``."""
    on_z = min(max(z, 0.0), height)
    distance = math.hypot(beyond, z - on_z)
    if distance == 0.0:
        return 0.0, out_x, out_y, 0.0, foot_x, foot_y, on_z
    return (
        distance,
        out_x * beyond / distance,
        out_y * beyond / distance,
        (z - on_z) / distance,
        foot_x,
        foot_y,
        on_z,
    )


def _off_an_end(x: float, y: float, height: float, over: float, under: float) -> Nearest:
    """Return the nearest point of the top or the bottom to one within the outline."""
    if over >= under:
        return over, 0.0, 0.0, 1.0, x, y, height
    return under, 0.0, 0.0, -1.0, x, y, 0.0
