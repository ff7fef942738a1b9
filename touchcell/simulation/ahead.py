"""What lies ahead of a tip that approaches along its axis, for ``touchcell check``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.surfaces import Surface

_TOUCHING_M: Final = 0.05e-3
_MOST_STEPS: Final = 500
_LONGEST_STEP: Final = 0.25
_STEEP_RAD: Final = math.radians(20.0)
_STEP_M: Final = 4e-3
_TINY: Final = 1e-12
_FAR: Final = 4.0
"""How much further than the reach is searched, to say how far away the surface is."""


def remark_on_approach(
    surfaces: Mapping[str, Surface], T_world_s: Array, tip_radius_m: float, reach_m: float
) -> str | None:
    """Return what is wrong with an approach to surfaces that stand as at the start; None where it makes contact.

    Args:
        surfaces: by name.
        T_world_s: (4, 4) pose of the sensor, from which it moves along its z axis.
        tip_radius_m: radius of the tip.
        reach_m: distance within which it has to make contact.
    """
    centre, axis = T_world_s[:3, 3], T_world_s[:3, 2]
    gap_m, name, _, _ = _nearest(surfaces, centre, tip_radius_m)
    if gap_m <= 0.0:
        return f"the tip starts {-1e3 * gap_m:.1f} mm deep in {name}; start it clear of everything"
    travelled_m, closest = 0.0, (math.inf, "", np.zeros(3))
    for _ in range(_MOST_STEPS):
        gap_m, name, normal, point = _nearest(surfaces, centre + travelled_m * axis, tip_radius_m)
        if gap_m <= _TOUCHING_M:
            return _remark_on_contact(name, travelled_m, -float(normal @ axis), reach_m)
        closest = min(closest, (gap_m, name, point), key=lambda each: each[0])
        travelled_m += min(gap_m, _LONGEST_STEP * reach_m)
        if travelled_m > _FAR * reach_m:
            break
    at = ", ".join(f"{1e3 * each:.0f}" for each in closest[2])
    return (
        f"no surface lies ahead of the tip; it would pass {closest[1]} at {1e3 * closest[0]:.0f} mm, "
        f"whose nearest point is ({at}) mm"
    )


def way_over(
    surfaces: Sequence[Surface],
    T_world_s: Array,
    direction_rad: float,
    distance_m: float,
    height_m: float,
    reach_m: float,
    back_m: float,
) -> Array | None:
    """Return the way (n, 3), m, of a tip's centre that touches surfaces and goes straight over them, normal to them.

    Args:
        surfaces: that stand still.
        T_world_s: (4, 4) pose of the sensor, from which it moves along its z axis.
        direction_rad: of the way, from the sensor's x axis towards its y axis.
        distance_m: length of the way.
        height_m: of the tip's centre over the surface in contact.
        reach_m: distance within which it has to make contact.
        back_m: how far it withdraws at the end, along the last normal; that is the last row.
    """
    met = first_contact(surfaces, T_world_s[:3, 3], T_world_s[:3, 2], height_m, reach_m)
    if met is None:
        return None
    centre, normal = met
    named = {str(k): surface for k, surface in enumerate(surfaces)}
    forward = T_world_s[:3, :2] @ np.array([math.cos(direction_rad), math.sin(direction_rad)])
    way, steps = [centre], max(1, min(_MOST_STEPS, math.ceil(distance_m / _STEP_M)))
    for _ in range(steps):
        forward = forward - float(forward @ normal) * normal
        forward = forward / max(float(np.linalg.norm(forward)), _TINY)
        centre = centre + distance_m / steps * forward
        gap_m, _, normal, _ = _nearest(named, centre, height_m)
        centre = centre - gap_m * normal
        way.append(centre)
    way.append(centre + back_m * normal)
    return np.array(way)


def points_over(
    surfaces: Sequence[Surface], T_world_s: Array, points: Array, height_m: float, reach_m: float
) -> Array | None:
    """Return where (n, 3), m, a tip's centre is at points (n, 2), m, of the plane in which its contact settles.

    The arguments are those of ``way_over``. Where nothing is below a point, the place in the plane is returned.
    """
    met = first_contact(surfaces, T_world_s[:3, 3], T_world_s[:3, 2], height_m, reach_m)
    if met is None:
        return None
    origin, normal = met
    # The sensor turns to the surface by the smallest rotation.
    turn = np.cross(T_world_s[:3, 2], -normal)
    R = T_world_s[:3, :3]
    if (sin := float(np.linalg.norm(turn))) > _TINY:
        angle = math.atan2(sin, -float(normal @ T_world_s[:3, 2]))
        R = se3.exp(np.concatenate([np.zeros(3), angle / sin * turn]))[:3, :3] @ R
    found = []
    for x, y in points:
        place = origin + R[:, :2] @ np.array([x, y])
        above = place - reach_m * R[:, 2]
        below = first_contact(surfaces, above, R[:, 2], height_m, 2.0 * reach_m)
        found.append(place if below is None else below[0])
    return np.array(found)


def first_contact(
    surfaces: Sequence[Surface], start: Array, axis: Array, height_m: float, reach_m: float
) -> tuple[Array, Array] | None:
    """Return where (3,) a tip's centre that goes along an axis (3,) is at its height over a surface, and the normal."""
    named, travelled_m = {str(k): surface for k, surface in enumerate(surfaces)}, 0.0
    for _ in range(_MOST_STEPS):
        centre = start + travelled_m * axis
        gap_m, _, normal, _ = _nearest(named, centre, height_m)
        if gap_m <= _TOUCHING_M:
            return centre, normal
        travelled_m += gap_m
        if travelled_m > reach_m:
            break
    return None


def _remark_on_contact(name: str, travelled_m: float, cos_tilt: float, reach_m: float) -> str | None:
    if travelled_m > reach_m:
        return f"the tip meets {name} after {1e3 * travelled_m:.0f} mm only, and searches for {1e3 * reach_m:.0f} mm"
    tilt = math.acos(min(max(cos_tilt, -1.0), 1.0))
    if tilt > _STEEP_RAD:
        return f"the tip meets {name} at {math.degrees(tilt):.0f} deg to its face; turn the start pose towards it"
    return None


def _nearest(surfaces: Mapping[str, Surface], p: Array, tip_radius_m: float) -> tuple[float, str, Array, Array]:
    """Return the gap in metres, the name of the surface, its normal (3,) and the nearest point (3,) m, in the world."""
    best = (math.inf, "", np.zeros(3), np.zeros(3))
    for name, surface in surfaces.items():
        found = surface.nearest(p, 0.0)
        if found.distance_m - tip_radius_m < best[0]:
            best = (found.distance_m - tip_radius_m, name, found.normal, found.point)
    return best
