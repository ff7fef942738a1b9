"""What lies ahead of a tip that approaches along its axis, for ``touchcell check``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.geometry.vectors import cross
from touchcell.simulation.edges import nearest_edge
from touchcell.simulation.surfaces import Surface

_TOUCHING_M: Final = 0.05e-3
_MOST_STEPS: Final = 500
_LONGEST_STEP: Final = 0.25
_STEEP_RAD: Final = math.radians(20.0)
_STEP_M: Final = 4e-3
_TINY: Final = 1e-12
_START_M: Final = 5e-3
"""The gap at a start that is advised."""
_TURNED_M: Final = 1e-3
"""What turning about a contact may take of it."""
_FARTHEST_M: Final = 0.5
_INSIDE_M: Final = (0.0, 5e-3, 15e-3, 30e-3)
"""How far beyond the nearest point a start is moved across its axis: the nearest point may be on a silhouette."""
_INSIDE_EDGE_M: Final = 8e-3
_BEYOND_EDGE_M: Final = 2.5e-3
_MOST_TURN_RAD: Final = math.radians(60.0)
_BESIDE_CORNER_M: Final = 6e-3
_CORNER_RAD: Final = math.radians(35.0)
_ALONG_M: Final = 15e-3
_AT_EDGE_MM_DEG: Final = np.array([-2.0, 0.0, -5.0, 0.0, 0.0, 0.0])
_ON_FACE_M: Final = 0.5e-3
"""How far inside its edge a tip is moved along, so that at a corner the next edge is the nearer one."""
_ON_EDGE_M: Final = 0.2e-3
_FEWEST_OF_LOOP: Final = 8
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


def remark_on_edge(surfaces: Sequence[Surface], T_world_s: Array, tip_radius_m: float, reach_m: float) -> str | None:
    """Return why the first contact is not one with an edge to follow; None where it is, or there is no contact."""
    met = _contact_pose(surfaces, T_world_s, tip_radius_m, reach_m)
    if met is None:
        return None
    T_world_e = nearest_edge(surfaces, met, 0.0, tip_radius_m)
    if T_world_e is None:
        return None
    T_e_s = se3.compose(se3.inverse(T_world_e), met)
    beyond_m, turn = float(T_e_s[0, 3]), math.atan2(T_e_s[1, 0], T_e_s[0, 0])
    if not -_INSIDE_EDGE_M <= beyond_m <= _BEYOND_EDGE_M:
        where = "inside" if beyond_m < 0.0 else "beyond"
        return f"the tip comes down {1e3 * abs(beyond_m):.0f} mm {where} the nearest edge"
    if abs(turn) > _MOST_TURN_RAD:
        return (
            f"the tip comes down on an edge with its x axis turned by {math.degrees(turn):.0f} deg from the way across "
            "it, away from the face"
        )
    if _is_at_corner(surfaces, T_world_e, tip_radius_m):
        return "the tip comes down at a corner; start along a side"
    return None


def _is_at_corner(surfaces: Sequence[Surface], T_world_e: Array, tip_radius_m: float) -> bool:
    """Return whether an edge turns a corner close to the frame {e} (4, 4)."""
    for aside_m in (-_BESIDE_CORNER_M, _BESIDE_CORNER_M):
        T = _farther_along(surfaces, T_world_e, aside_m, tip_radius_m)
        if float(T[:3, 0] @ T_world_e[:3, 0]) < math.cos(_CORNER_RAD):
            return True
    return False


def _farther_along(surfaces: Sequence[Surface], T_world_e: Array, step_m: float, tip_radius_m: float) -> Array:
    """Return the frame {e} (4, 4) of the edge that is nearest to a place farther along the y axis of one."""
    ahead = np.eye(4)
    ahead[:2, 3] = -_ON_FACE_M, step_m
    T = nearest_edge(surfaces, se3.compose(T_world_e, ahead), 0.0, tip_radius_m)
    assert T is not None
    return T


def way_along_edge(
    surfaces: Sequence[Surface],
    T_world_s: Array,
    tip_radius_m: float,
    reach_m: float,
    distance_m: float,
    step_m: float,
) -> Array | None:
    """Return the frames {e} (n, 4, 4) along the edge that a tip meets, until the way is long enough or closed.

    Args:
        surfaces: what stands still.
        T_world_s: (4, 4) pose of the sensor, from which it moves along its z axis.
        tip_radius_m: radius of the tip.
        reach_m: distance within which it makes contact.
        distance_m: length of the way.
        step_m: from point to point along the edge's y axis; negative against it.
    """
    met = _contact_pose(surfaces, T_world_s, tip_radius_m, reach_m)
    T_world_e = None if met is None else nearest_edge(surfaces, met, 0.0, tip_radius_m)
    if T_world_e is None:
        return None
    way = [T_world_e]
    for _ in range(math.ceil(distance_m / abs(step_m))):
        T_world_e = _farther_along(surfaces, T_world_e, step_m, tip_radius_m)
        way.append(T_world_e)
        if len(way) > _FEWEST_OF_LOOP and float(np.linalg.norm((way[-1] - way[0])[:3, 3])) < abs(step_m):
            break
    return np.array(way)


def start_near(
    surfaces: Mapping[str, Surface],
    T_world_s: Array,
    tip_radius_m: float,
    reach_m: float,
    *,
    on_edge: bool = False,
    allowed: Callable[[Array], bool] = lambda T_world_s: True,
) -> Array | None:
    """Return the pose (4, 4) of a sensor, near that of a start, from which it comes upon a surface.

    The start is moved along its axis or across it, as little as is needed, and turned towards the surface where that
    does not do. None where there is nothing to mend, or no such pose is found.

    Args:
        surfaces: by name.
        T_world_s: (4, 4) pose of the sensor at the start.
        tip_radius_m: radius of the tip.
        reach_m: distance within which it has to make contact.
        on_edge: it shall come down on an edge, with its x axis across it and away from the face.
        allowed: tells whether the sensor may be at a pose.
    """
    bodies = list(surfaces.values())

    def is_good(T: Array) -> bool:
        if remark_on_approach(surfaces, T, tip_radius_m, reach_m) is not None:
            return False
        return not on_edge or remark_on_edge(bodies, T, tip_radius_m, reach_m) is None

    if is_good(T_world_s):
        return None
    for T in _other_starts(surfaces, T_world_s, tip_radius_m):
        if on_edge:
            near = _contact_pose(bodies, T, tip_radius_m, reach_m)
            T_world_e = None if near is None else nearest_edge(bodies, near, 0.0, tip_radius_m)
            if T_world_e is None:
                continue
            T = se3.compose(T_world_e, se3.from_euler_mm_deg(_AT_EDGE_MM_DEG))
            kept = _as_tilted(T_world_e, T_world_s[:3, 2])
        for candidate in chain((kept, T), _along_edge(bodies, T, tip_radius_m)) if on_edge else (T,):
            if is_good(candidate) and allowed(candidate):
                return candidate
    return None


def _as_tilted(T_world_e: Array, axis: Array) -> Array:
    """Return the start (4, 4) at an edge of a tip that keeps the axis (3,), as one that is never tilted has to."""
    p = T_world_e[:3, 3] + 1e-3 * _AT_EDGE_MM_DEG[0] * T_world_e[:3, 0]
    return _at(_turned(T_world_e[:3, :3], -axis), p - (_START_M + _TURNED_M) * axis)


def _along_edge(surfaces: Sequence[Surface], T_world_s: Array, tip_radius_m: float) -> Iterator[Array]:
    """Yield starts farther along the edge that a start is at, to either side."""
    T_world_e = nearest_edge(surfaces, T_world_s, 0.0, tip_radius_m)
    assert T_world_e is not None
    for aside_m in (-_ALONG_M, _ALONG_M):
        T = _farther_along(surfaces, T_world_e, aside_m, tip_radius_m)
        yield se3.compose(T, se3.from_euler_mm_deg(_AT_EDGE_MM_DEG))


def _other_starts(surfaces: Mapping[str, Surface], T_world_s: Array, tip_radius_m: float) -> Iterator[Array]:
    """Yield poses 5 mm over a surface: along the axis of a start, across it, and along the normal."""
    centre, axis = T_world_s[:3, 3], T_world_s[:3, 2]
    bodies, high_m = list(surfaces.values()), tip_radius_m + _START_M
    back = centre - _FARTHEST_M * axis
    met = first_contact(bodies, back, axis, high_m, 2.0 * _FARTHEST_M)
    if met is not None:
        yield _at(T_world_s[:3, :3], met[0])
        yield _at(_turned(T_world_s[:3, :3], met[1]), met[0] + _TURNED_M * met[1])
    _, _, normal, point = _nearest(surfaces, centre, tip_radius_m)
    aside = point - centre
    aside = aside - float(aside @ axis) * axis
    length_m = float(np.linalg.norm(aside))
    for inside_m in _INSIDE_M if length_m > _TINY else ():
        there = back + (1.0 + inside_m / length_m) * aside
        met = first_contact(bodies, there, axis, high_m, 2.0 * _FARTHEST_M)
        if met is not None:
            yield _at(T_world_s[:3, :3], met[0])
            yield _at(_turned(T_world_s[:3, :3], met[1]), met[0] + _TURNED_M * met[1])
    yield _at(_turned(T_world_s[:3, :3], normal), point + high_m * normal)


def _contact_pose(surfaces: Sequence[Surface], T_world_s: Array, tip_radius_m: float, reach_m: float) -> Array | None:
    """Return the pose (4, 4) in which a tip that goes along its axis first touches, turned to what it touches."""
    met = first_contact(surfaces, T_world_s[:3, 3], T_world_s[:3, 2], tip_radius_m, reach_m)
    return None if met is None else _at(_turned(T_world_s[:3, :3], met[1]), met[0])


def _at(R: Array, p: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _turned(R: Array, normal: Array) -> Array:
    """Return axes (3, 3) turned by the smallest rotation that brings their z axis against a normal (3,)."""
    turn = cross(R[:, 2], -normal)
    sin = float(np.linalg.norm(turn))
    if sin <= _TINY:
        return R
    angle = math.atan2(sin, -float(normal @ R[:, 2]))
    turned: Array = se3.exp(np.concatenate([np.zeros(3), angle / sin * turn]))[:3, :3] @ R
    return turned


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
    surfaces: Sequence[Surface],
    T_world_s: Array,
    points: Array,
    height_m: float,
    reach_m: float,
    *,
    of_edges: bool = False,
) -> Array | None:
    """Return where (n, 3), m, a tip's centre is at points (n, 2), m, of the plane in which its contact settles.

    The arguments are those of ``way_over``. The result is (n, 2, 3) with the outward normals of what is touched there;
    where nothing is below a point, it is the place in the plane, and nan; so is the normal where an edge is touched
    from beyond its face, unless ``of_edges`` asks for it.
    """
    met = first_contact(surfaces, T_world_s[:3, 3], T_world_s[:3, 2], height_m, reach_m)
    if met is None:
        return None
    origin, normal = met
    R = _turned(T_world_s[:3, :3], normal)
    found = []
    for x, y in points:
        place = origin + R[:, :2] @ np.array([x, y])
        above = place - reach_m * R[:, 2]
        below = first_contact(surfaces, above, R[:, 2], height_m, 2.0 * reach_m)
        if below is None:
            below = place, np.full(3, np.nan)
        elif not of_edges and _is_beyond_face(surfaces, *below, height_m):
            below = below[0], np.full(3, np.nan)
        found.append(below)
    return np.array(found)


def _is_beyond_face(surfaces: Sequence[Surface], centre: Array, normal: Array, height_m: float) -> bool:
    """Return whether a tip whose centre is ``height_m`` over what it touches, along a normal (3,), touches an edge."""
    T_world_e = nearest_edge(surfaces, _at(_turned(np.eye(3), normal), centre), 0.0, height_m)
    if T_world_e is None:
        return False
    # {e} is as far over its edge, along the normal of the face.
    away = centre - height_m * normal - (T_world_e[:3, 3] + height_m * T_world_e[:3, 2])
    leaning = float(normal @ T_world_e[:3, 2]) > -math.cos(_STEEP_RAD)
    return leaning and float(np.linalg.norm(away)) < _ON_EDGE_M


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
