"""Target alignment: steer a pushed object towards its target by moving the contact sideways (paper 3.3.3)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.control.path import Path, Point
from touchcell.control.pid import Pid, PidGains
from touchcell.geometry.types import Array

MAX_CRAB_RAD: Final = math.radians(25.0)
"""Furthest that an object is headed aside to go straight: it is pushed this far beside its middle."""
MAX_INTEGRATED_M: Final = 0.015
"""Larger distances from the path are not integrated: on the way back to it the integral would only gather overshoot."""


@dataclass(frozen=True, slots=True)
class AlignmentGains:
    """How a pushed object is steered.

    Attributes:
        kp: sideways speed per bearing of the point aimed at, m/s per rad.
        ki: how fast the object is headed aside per distance from the path, rad per m and s.
        kd: sideways speed per rate of the bearing, m per rad.
        limit_m_s: largest sideways speed.
        look_ahead_m: how far ahead on the path it aims.
        lead_m: where the object turns, ahead of the middle of the tip.
    """

    kp: float
    ki: float
    kd: float
    limit_m_s: float
    look_ahead_m: float
    lead_m: float


@dataclass(frozen=True, slots=True)
class Aim:
    """How the object stands to its target.

    Attributes:
        theta_rad: bearing of the point aimed at, from the contact normal, positive to its left.
        remaining_m: way that is left.
        cross_track_error_m: distance of the object from its path, positive to its left.
        target_lateral_error_m: distance of the target from the contact normal, positive to its left.
        heading_rad: of the contact normal in the base frame.
    """

    theta_rad: float
    remaining_m: float
    cross_track_error_m: float
    target_lateral_error_m: float
    heading_rad: float


class TargetAlignment:
    """A PID on a bearing that moves the contact to the other side, which turns the object towards where it shall go.

    Pushed at its near side, an object turns about a point ahead of the contact, near its middle: to head left, the
    contact has to go right. Seen from that point, ``lead_m`` ahead, the object is steered like a unicycle.

    The paper takes the bearing of the target from the sensor. From there the sideways motion itself turns the bearing
    the wrong way, as much as the object's turn rights it when the target is at ``lead_m``; so it has to be switched off
    before the end, and an object that is not pushed through its middle then goes astray. Here the bearing is taken from
    where the object turns, of a point ``look_ahead_m`` further on the straight path to the target (pure pursuit), and
    it is the distance from that path that is integrated: the object may head a little aside to go straight. That works
    until the end, and along bent paths.

    Args:
        route: from where the object's middle is (x, y, m, in the base frame) and heads (rad) when pushing begins to the
            points of the way, without the first one; the last one is the target.
        gains: see there.

    Raises:
        ControlError: a number is not finite or a limit negative.
    """

    def __init__(self, route: Callable[[Point, float], Sequence[Point]], gains: AlignmentGains) -> None:
        kp, ki, kd = np.zeros((3, 6, 6))
        kp[1, 1], ki[1, 0], kd[1, 1] = gains.kp, gains.kp * gains.ki, gains.kd
        most_aside = np.array([0.0, gains.kp * MAX_CRAB_RAD, 0.0, 0.0, 0.0, 0.0])
        zone = np.array([MAX_INTEGRATED_M, 0.0, 0.0, 0.0, 0.0, 0.0])
        limit = np.array([0.0, gains.limit_m_s, 0.0, 0.0, 0.0, 0.0])
        self._pid = Pid(PidGains(kp, ki, kd, most_aside, zone, limit))
        self._route = route
        self._gains = gains
        self._path: Path | None = None
        self._along_m = 0.0

    def pause(self) -> None:
        """The motion was interrupted: forget the past, but not the path."""
        self._pid.reset()

    def aim(self, T_base_sensor: Array, T_s_f: Array) -> Aim:
        """How the object stands now. The first time it also lays the path from there.

        Args:
            T_base_sensor: (4, 4) pose of the sensor, its x axis upright.
            T_s_f: (4, 4) contact: z of the surface frame is the inward normal.

        Raises:
            ControlError: the path is none.
        """
        normal = T_base_sensor[:2, :3] @ T_s_f[:3, 2]
        length = math.hypot(normal[0], normal[1])
        nx, ny = float(normal[0]) / length, float(normal[1]) / length
        tip = float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3])
        middle = tip[0] + self._gains.lead_m * nx, tip[1] + self._gains.lead_m * ny
        heading = math.atan2(ny, nx)
        if self._path is None:
            self._path = Path([middle, *self._route(middle, heading)])
        place = self._path.place(middle, self._along_m, self._gains.look_ahead_m)
        self._along_m = max(self._along_m, place.along_m)
        ahead = self._path.point(place.along_m + self._gains.look_ahead_m)
        dx, dy = ahead[0] - middle[0], ahead[1] - middle[1]
        theta = math.atan2(nx * dy - ny * dx, nx * dx + ny * dy)
        target = self._path.end
        target_aside = nx * (target[1] - tip[1]) - ny * (target[0] - tip[0])
        remaining_m = self._path.length_m - place.along_m
        return Aim(theta, remaining_m, place.cross_track_error_m, target_aside, heading)

    def step(self, aim: Aim, dt_s: float) -> float:
        """Speed of the contact to the left of the contact normal, m/s."""
        e = np.array([-aim.cross_track_error_m, aim.theta_rad, 0.0, 0.0, 0.0, 0.0])
        return -float(self._pid.step(e, np.zeros(6), dt_s)[1])
