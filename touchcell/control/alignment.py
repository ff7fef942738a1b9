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
"""Largest crab angle, at which the object travels straight although it is pushed beside its centre."""
MAX_INTEGRATED_M: Final = 0.015
"""Anti-windup zone: larger cross-track errors are not integrated, they would only cause overshoot."""


@dataclass(frozen=True, slots=True)
class AlignmentGains:
    """Gains and limits of target alignment.

    Attributes:
        kp: lateral speed per bearing of the look-ahead point, m/s per rad.
        ki: crab angle rate per cross-track error, rad per m and s.
        kd: lateral speed per rate of the bearing, m per rad.
        limit_m_s: largest lateral speed.
        look_ahead_m: look-ahead distance along the path.
        lead_m: distance from the centre of the tip forward to the object's turning centre, where the tip just touches.
    """

    kp: float
    ki: float
    kd: float
    limit_m_s: float
    look_ahead_m: float
    lead_m: float


@dataclass(frozen=True, slots=True)
class Aim:
    """Pose of the pushed object relative to its path and target.

    Attributes:
        theta_rad: bearing of the look-ahead point, from the contact normal, positive to its left.
        remaining_m: remaining path length.
        cross_track_error_m: distance of the object from its path, positive to its left.
        target_lateral_error_m: distance of the target from the contact normal, positive to its left.
        target_distance_m: distance of the target from the object's turning centre.
        heading_rad: heading of the contact normal in the base frame.
    """

    theta_rad: float
    remaining_m: float
    cross_track_error_m: float
    target_lateral_error_m: float
    target_distance_m: float
    heading_rad: float


class TargetAlignment:
    """PID on a bearing: moves the contact to the opposite side, which turns the object towards its path.

    Pushed at its near side, an object turns about a point ahead of the contact, near its centre: to head left, the
    contact has to move right. Seen from that point, ``lead_m`` ahead, the object steers like a unicycle.

    The paper (section 3.3.3) measures the bearing of the target from the sensor. There the lateral motion itself turns
    the bearing the wrong way, as much as the object's turn corrects it when the target is at ``lead_m``; so it has to
    be switched off before the end, and an object that is not pushed through its centre then drifts off. Here the
    bearing is measured from the turning centre, to a point ``look_ahead_m`` further on the straight path to the target
    (pure pursuit), and the integrated quantity is the cross-track error: the object may crab a little to travel
    straight. That works to the end, and along curved paths.

    Args:
        route: (x, y, m, base frame) waypoints from the object's centre and heading (rad) at the start of the push,
            without
            the start itself; the last one is the target.
        gains: gains and limits.

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
        """Reset the PID after the motion was interrupted, but keep the path."""
        self._pid.reset()

    def aim(self, T_base_sensor: Array, T_s_f: Array) -> Aim:
        """Return the object's pose relative to its path. The first call also lays the path from there.

        Args:
            T_base_sensor: (4, 4) pose of the sensor, its x axis upright.
            T_s_f: (4, 4) contact: z of the surface frame is the inward normal.

        Raises:
            ControlError: the path is degenerate.
        """
        normal = T_base_sensor[:2, :3] @ T_s_f[:3, 2]
        length = math.hypot(normal[0], normal[1])
        nx, ny = float(normal[0]) / length, float(normal[1]) / length
        tip = float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3])
        # The tip gives way: the object's surface is nearer to the tip's centre by the depth of the contact.
        depth_m = max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
        lead_m = self._gains.lead_m - depth_m
        centre = tip[0] + lead_m * nx, tip[1] + lead_m * ny
        heading = math.atan2(ny, nx)
        if self._path is None:
            self._path = Path([centre, *self._route(centre, heading)])
        place = self._path.place(centre, self._along_m, self._gains.look_ahead_m)
        self._along_m = max(self._along_m, place.along_m)
        ahead = self._path.point(place.along_m + self._gains.look_ahead_m)
        dx, dy = ahead[0] - centre[0], ahead[1] - centre[1]
        theta = math.atan2(nx * dy - ny * dx, nx * dx + ny * dy)
        target = self._path.end
        target_aside = nx * (target[1] - tip[1]) - ny * (target[0] - tip[0])
        remaining_m = self._path.length_m - place.along_m
        distance_m = math.hypot(target[0] - centre[0], target[1] - centre[1])
        return Aim(theta, remaining_m, place.cross_track_error_m, target_aside, distance_m, heading)

    def step(self, aim: Aim, dt_s: float) -> float:
        """Return the speed of the contact to the left of the contact normal, m/s."""
        e = np.array([-aim.cross_track_error_m, aim.theta_rad, 0.0, 0.0, 0.0, 0.0])
        return -float(self._pid.step(e, np.zeros(6), dt_s)[1])
