"""Follow a surface: slide over it at constant depth, normal to it (paper 5, surface following).

Either in one direction of the sensor, as in the paper, or along a planned path that is projected onto the surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated

import numpy as np
from pydantic import PositiveFloat

from touchcell.control.path import Point
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import SixGains
from touchcell.tasks.felt_curvature import CurvedWay
from touchcell.tasks.interface import DEPTH, DISTANCE, SPEED
from touchcell.tasks.planned_motions import PlannedMotion, PlannedSlide
from touchcell.tasks.planned_places import PlannedPlace
from touchcell.tasks.servoing import ARM, ServoConfig, one_arm_task, servo_motions
from touchcell.tasks.surface_path import Guide, PathConfig, along

_APPROACH_M = 0.02
"""The first contact is hardly farther from the start than this."""
_BEND = 0.5
"""Share of a way by which its end may be elsewhere: on a plane tilted by 30 deg."""


class SurfaceFollowingConfig(ServoConfig):
    """Parameters of surface following. Shear is not controlled: its gains are zero.

    Attributes:
        depth_mm: indentation to hold, normal to the surface.
        speed_mm_s: tangential speed of the sensor.
        direction_deg: direction of travel, from the sensor's x axis towards its y axis.
        distance_mm: distance that the sensor travels.
        path: path to follow in place of a direction and a distance; see ``surface_path``.
        lookahead_mm: how far ahead on the path the sensor heads.
        bend_window_mm: the curvature felt over about this last stretch turns the sensor ahead; see ``felt_curvature``.
    """

    depth_mm: Annotated[PositiveFloat, DEPTH] = 3.0
    kp_per_s: SixGains = (0.0, 0.0, 8.0, 8.0, 8.0, 0.0)
    ki_per_s2: SixGains = (0.0, 0.0, 16.0, 16.0, 16.0, 0.0)
    speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    direction_deg: float = 0.0
    distance_mm: Annotated[PositiveFloat, DISTANCE] = 100.0
    path: PathConfig | None = None
    lookahead_mm: PositiveFloat = 2.0
    bend_window_mm: PositiveFloat = 8.0
    return_lift_mm: PositiveFloat | None = 3.0


class Follow:
    """Behavior of surface following: a tangential feedforward until the distance is covered."""

    def __init__(self, config: SurfaceFollowingConfig) -> None:
        angle = np.radians(config.direction_deg)
        self._direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        self._way = _curved_way(config)
        self._left_m = 1e-3 * config.distance_mm
        self._timeout_s = 6.0 * config.distance_mm / config.speed_mm_s + 5.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return self._way.twist

    @property
    def timeout_s(self) -> float:
        """Six times the nominal duration, for bends, plus five seconds."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Add up the distance along the direction of travel; return True once it is covered.

        Noise and corrections in other directions do not count.
        """
        self._way.update(self._direction, now, T_s_f)
        self._left_m -= float(self._direction @ now[:3, :3].T @ (now[:3, 3] - before[:3, 3]))
        return self._left_m <= 0.0

    def shortfall(self) -> str:
        """Return nothing: it finishes where its distance is covered."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return the speed, which falls in bends."""
        return {"speed_mm_s": 1e3 * self._way.speed_m_s}


class FollowPath:
    """Behavior of surface following along a planned path."""

    def __init__(self, config: SurfaceFollowingConfig, path: PathConfig) -> None:
        self._guide = Guide(path.points(), 1e-3 * config.lookahead_mm)
        self._way = _curved_way(config)
        # A path over a surface is longer than in its plane, and slower where it bends.
        self._timeout_s = 6e3 * self._guide.length_m / config.speed_mm_s + 5.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return self._way.twist

    @property
    def timeout_s(self) -> float:
        """Six times the duration on a plane, plus five seconds."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Head for the next point of the path; return True at its end."""
        self._way.update(self._guide.direction(now), now, T_s_f)
        return self._guide.along_m >= self._guide.length_m

    def shortfall(self) -> str:
        """Return nothing: it finishes at the end of its path."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return how much of the path is left, how far beside it the sensor is, and its speed, which falls in bends."""
        return {
            "speed_mm_s": 1e3 * self._way.speed_m_s,
            "path_left_mm": 1e3 * max(self._guide.length_m - self._guide.along_m, 0.0),
            "cross_track_error_mm": 1e3 * self._guide.cross_track_error_m,
        }


def _curved_way(config: SurfaceFollowingConfig) -> CurvedWay:
    fastest_rad_s = math.radians(config.max_turn_deg_s)
    return CurvedWay(1e-3 * config.speed_mm_s, fastest_rad_s, 1e-3 * config.bend_window_mm)


def _behavior(config: SurfaceFollowingConfig) -> Follow | FollowPath:
    return Follow(config) if config.path is None else FollowPath(config, config.path)


def _places(config: SurfaceFollowingConfig, T_base_tcp: Array | None, T_tcp_sensor: Array) -> Iterator[PlannedPlace]:
    """Return the corners of the path, or the end of the straight way, near the plane of the first contact."""
    if T_base_tcp is None:
        return
    T_base_sensor = T_base_tcp @ T_tcp_sensor
    key, corners = ("path",), [_end(config)] if config.path is None else config.path.corners()
    for x, y in corners:
        tip_m = T_base_sensor[:3, 3] + T_base_sensor[:3, :2] @ np.array([x, y])
        slack_m = _APPROACH_M + _BEND * math.hypot(x, y)
        yield PlannedPlace(("distance_mm",) if config.path is None else key, ARM, tip_m=tip_m, slack_m=slack_m)


def _end(config: SurfaceFollowingConfig) -> Point:
    """Return where the straight way ends, m, from the first contact on, along the sensor's x and y axes."""
    angle, distance_m = math.radians(config.direction_deg), 1e-3 * config.distance_mm
    return distance_m * math.cos(angle), distance_m * math.sin(angle)


def _motions(config: SurfaceFollowingConfig) -> Iterator[PlannedMotion]:
    yield from servo_motions(config)
    along_m = [_end(config)] if config.path is None else config.path.corners()
    yield PlannedSlide(
        ("distance_mm",) if config.path is None else ("path",),
        max(math.hypot(x, y) for x, y in along_m),
        math.radians(config.direction_deg),
        1e-3 * config.speed_mm_s,
        1e-3 * config.depth_mm,
        "run",
        corners_m=() if config.path is None else tuple(along_m),
        way_m=() if config.path is None else tuple(along(config.path.points())),
    )


SPEC = one_arm_task(
    "surface_following",
    "slide over an unknown surface at constant depth and normal to it",
    SurfaceFollowingConfig,
    _behavior,
    lambda config: (0.0, 0.0, config.depth_mm, 0.0, 0.0, 0.0),
    _places,
    lambda config, start, mount: _motions(config),
    surface_rests=True,
)
