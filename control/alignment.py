"""Target alignment: steer a pushed object towards its target by moving the contact sideways (paper 3.3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from control.pid import Pid, PidGains
from geometry.types import Array


@dataclass(frozen=True, slots=True)
class Bearing:
    """Where the target lies, seen along the contact normal in the plane of pushing.

    Attributes:
        ahead_m: from the middle of the tip, along the normal.
        aside_m: along the sensor's y axis, turned with the normal: the distance of the target from the normal, signed.
    """

    ahead_m: float
    aside_m: float

    @property
    def theta_rad(self) -> float:
        """From the normal to the target, positive towards the y axis."""
        return math.atan2(self.aside_m, self.ahead_m)

    @property
    def rho_m(self) -> float:
        """Distance of the target."""
        return math.hypot(self.ahead_m, self.aside_m)


def bearing(T_base_sensor: Array, T_s_f: Array, target: Array) -> Bearing:
    """Bearing of ``target`` (2,) m, x and y in the arm's base frame whose z axis is upright.

    Args:
        T_base_sensor: (4, 4) pose of the sensor, its x axis upright.
        T_s_f: (4, 4) contact: z of the surface frame is the inward normal.
        target: (2,) m.
    """
    normal = T_base_sensor[:2, :3] @ T_s_f[:3, 2]
    length = math.hypot(normal[0], normal[1])
    nx, ny = normal[0] / length, normal[1] / length
    # The sensor's y axis lies to the left of the normal if its x axis points down.
    left = -math.copysign(1.0, T_base_sensor[2, 0])
    dx, dy = float(target[0] - T_base_sensor[0, 3]), float(target[1] - T_base_sensor[1, 3])
    return Bearing(nx * dx + ny * dy, left * (nx * dy - ny * dx))


class TargetAlignment:
    """A PID on the bearing that moves the contact away from the target's side, which turns the object towards it.

    Pushed at its near side, an object turns about a point ahead of the contact: to head left, the contact has to go
    right. Within ``off_m`` of the target the bearing says nothing of use any more and the motion is zero (Lloyd &
    Lepora 2021).

    Args:
        kp: m/s per rad.
        ki: m/s^2 per rad.
        kd: m per rad.
        limit_m_s: largest motion, and largest integral part of it.
        off_m: distance of the target, from the middle of the tip, within which it is switched off.

    Raises:
        ControlError: a number is not finite or a limit negative.
    """

    def __init__(self, kp: float, ki: float, kd: float, limit_m_s: float, off_m: float) -> None:
        limit = _along_y(limit_m_s)
        self._pid = Pid(PidGains(_along_y(kp), _along_y(ki), _along_y(kd), limit, np.full(6, np.pi), limit))
        self._off_m = off_m

    def reset(self) -> None:
        """Forget the past."""
        self._pid.reset()

    def step(self, seen: Bearing, dt_s: float) -> float:
        """Speed of the contact along the sensor's y axis, m/s."""
        if seen.rho_m < self._off_m:
            self._pid.reset()
            return 0.0
        return -float(self._pid.step(_along_y(seen.theta_rad), np.zeros(6), dt_s)[1])


def _along_y(value: float) -> Array:
    six = np.zeros(6)
    six[1] = value
    return six
