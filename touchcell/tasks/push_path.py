"""Path planning for pushing: the shortest smooth path to a position and heading, around obstacles.

A stably pushed object is steered like a car. Pushed at a point ``a`` behind its centre it turns, per distance, by
``a tan(phi) / c^2`` when the force is inclined by ``phi`` to the contact normal, with ``c`` the friction radius of its
bottom (the ellipsoidal limit surface, Goyal, Ruina & Papadopoulos 1991). The force stays inside the friction cone, so
the turning radius is at least ``c^2 / (a mu)``; paths are made of straight segments and arcs of that radius or more
(Dubins 1957).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from touchcell.control.path import Point
from touchcell.errors import TouchcellError

Pose = tuple[float, float, float]
"""x and y, m, and heading, rad."""

STEP_M = 0.005
# Dubins words, and for those of three arcs, on which side of the other two the middle one lies.
_KINDS = (("LSL", 0), ("RSR", 0), ("LSR", 0), ("RSL", 0), ("LRL", 1), ("LRL", -1), ("RLR", 1), ("RLR", -1))
_VIA_DIRECTIONS = 24


class NoPathFound(TouchcellError, ValueError):
    """No path is smooth enough and clear of the obstacles.

    Attributes:
        start, goal: poses.
    """

    def __init__(self, start: Pose, goal: Pose) -> None:
        super().__init__(
            f"no path from {_format(start)} to {_format(goal)} clear of the obstacles; "
            "a smaller turning radius or clearance may help"
        )
        self.start = start
        self.goal = goal


def _format(pose: Pose) -> str:
    return f"({1e3 * pose[0]:.0f}, {1e3 * pose[1]:.0f}) mm, {math.degrees(pose[2]):.0f} deg"


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Disc that the object's centre keeps out of: the obstacle enlarged by half of the object. Metres."""

    x_m: float
    y_m: float
    radius_m: float

    def hits(self, points: Sequence[Point]) -> bool:
        """Return True if any point lies inside."""
        limit = self.radius_m - 1e-6
        return any(math.hypot(x - self.x_m, y - self.y_m) < limit for x, y in points)


def min_turning_radius_m(contact_m: float, friction_radius_m: float, friction: float) -> float:
    """Return the smallest turning radius of a stable push, m.

    Args:
        contact_m: distance from the object's centre to the contact.
        friction_radius_m: of its bottom; see ``touchcell.simulation.solids.friction_radius_m``.
        friction: friction coefficient between skin and object.
    """
    return friction_radius_m**2 / (contact_m * friction)


def plan(start: Pose, goal: Pose, turn_m: float, obstacles: Sequence[Obstacle] = ()) -> list[Point]:
    """Plan the shortest path found, as points every few millimetres, without the start; the last one is the goal.

    Without obstacles it is the shortest of all. With them, paths through one via pose beside an obstacle are tried too.

    Args:
        start: pose of the object's centre.
        goal: likewise.
        turn_m: turning radius.
        obstacles: discs that its centre keeps out of.

    Raises:
        NoPathFound: no candidate is clear.
    """
    best: list[Point] | None = None
    length = math.inf
    for path, travelled_m in _candidates(start, goal, turn_m, obstacles):
        if travelled_m < length and not any(obstacle.hits(path) for obstacle in obstacles):
            best, length = path, travelled_m
    if best is None:
        raise NoPathFound(start, goal)
    return best


def length_m(points: Sequence[Point]) -> float:
    """Return the length of the polyline through ``points``, m."""
    return sum(math.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points))


def _candidates(
    start: Pose, goal: Pose, turn_m: float, obstacles: Sequence[Obstacle]
) -> Iterator[tuple[list[Point], float]]:
    for kind in _KINDS:
        if found := _dubins(start, goal, turn_m, *kind):
            yield found
    for obstacle in obstacles:
        around_m = max(obstacle.radius_m, 1e-3) + 1e-5
        for i in range(_VIA_DIRECTIONS):
            angle = 2.0 * math.pi * i / _VIA_DIRECTIONS
            at = obstacle.x_m + around_m * math.cos(angle), obstacle.y_m + around_m * math.sin(angle)
            for side in (0.5 * math.pi, -0.5 * math.pi):
                via = (*at, angle + side)
                to_via = _shortest(start, via, turn_m, obstacles)
                from_via = _shortest(via, goal, turn_m, obstacles)
                if to_via is not None and from_via is not None:
                    yield to_via[0] + from_via[0], to_via[1] + from_via[1]


def _shortest(
    start: Pose, goal: Pose, turn_m: float, obstacles: Sequence[Obstacle]
) -> tuple[list[Point], float] | None:
    found = [path for kind in _KINDS if (path := _dubins(start, goal, turn_m, *kind)) is not None]
    clear = [path for path in found if not any(obstacle.hits(path[0]) for obstacle in obstacles)]
    return min(clear, key=lambda path: path[1], default=None)


def _dubins(start: Pose, goal: Pose, turn_m: float, kind: str, side: int) -> tuple[list[Point], float] | None:
    """Return the points and length of the Dubins path of one kind, or None where it does not exist.

    L and R are arcs to the left and right, S is a straight segment.
    """
    first, last = _turning(kind[0]), _turning(kind[2])
    ax, ay = _centre(start, first, turn_m)
    bx, by = _centre(goal, last, turn_m)
    apart, towards = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
    if kind[1] == "S":
        if first == last:
            straight, heading = apart, towards
        else:
            square = apart * apart - 4.0 * turn_m * turn_m
            if square < 0.0:
                return None
            straight = math.sqrt(square)
            heading = towards + first * math.atan2(2.0 * turn_m, straight)
        turns = (_arc(start[2], heading, first), straight / turn_m, _arc(heading, goal[2], last))
    else:
        if apart > 4.0 * turn_m or apart < 1e-9:
            return None
        # Three circles of one radius touch: the middle one's centre is over the midpoint of the others' centres.
        lean = math.acos(apart / (4.0 * turn_m))
        to_middle = towards + side * lean
        mx, my = ax + 2.0 * turn_m * math.cos(to_middle), ay + 2.0 * turn_m * math.sin(to_middle)
        leave = to_middle + first * 0.5 * math.pi
        meet = math.atan2(by - my, bx - mx) - first * 0.5 * math.pi
        turns = (_arc(start[2], leave, first), _arc(leave, meet, -first), _arc(meet, goal[2], last))
    points, pose = [], start
    for letter, amount in zip(kind, turns, strict=True):
        count = max(math.ceil(amount * turn_m / STEP_M), 1) if amount > 1e-9 else 0
        for _ in range(count):
            pose = _go(pose, _turning(letter), amount / count, turn_m)
            points.append(pose[:2])
    if not points or math.hypot(pose[0] - goal[0], pose[1] - goal[1]) > 1e-6:
        return None
    points[-1] = goal[:2]
    return points, sum(turns) * turn_m


def _turning(kind: str) -> float:
    return {"L": 1.0, "S": 0.0, "R": -1.0}[kind]


def _centre(pose: Pose, turning: float, turn_m: float) -> Point:
    x, y, heading = pose
    return x - turning * turn_m * math.sin(heading), y + turning * turn_m * math.cos(heading)


def _arc(heading: float, to: float, turning: float) -> float:
    """Return the angle to turn by, from 0 up to a whole turn."""
    angle = (turning * (to - heading)) % (2.0 * math.pi)
    return 0.0 if 2.0 * math.pi - angle < 1e-9 else angle


def _go(pose: Pose, turning: float, amount: float, turn_m: float) -> Pose:
    """Return the pose after ``amount`` turning radii."""
    x, y, heading = pose
    if turning == 0.0:
        return x + amount * turn_m * math.cos(heading), y + amount * turn_m * math.sin(heading), heading
    cx, cy = _centre(pose, turning, turn_m)
    turned = heading + turning * amount
    return cx + turning * turn_m * math.sin(turned), cy - turning * turn_m * math.cos(turned), turned
