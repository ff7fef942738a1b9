"""Prescribed motions of simulated objects: smooth, with exact velocities."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from touchcell.geometry.types import Array


class Motion(Protocol):
    """Pose and velocity of a body as functions of time."""

    def pose(self, t_s: float) -> Array:
        """Return T_world_body (4, 4)."""
        ...

    def twist(self, t_s: float) -> Array:
        """Return (6,) [v, w]: velocity of the body's origin and angular velocity, along world axes."""
        ...


def _identity() -> Array:
    return np.eye(4)


@dataclass(frozen=True, slots=True)
class Still:
    """A body that stays at ``T_world_body``."""

    T_world_body: Array = field(default_factory=_identity)

    def pose(self, t_s: float) -> Array:
        """Return T_world_body (4, 4)."""
        return self.T_world_body

    def twist(self, t_s: float) -> Array:
        """Return zero."""
        return np.zeros(6)


@dataclass(frozen=True, slots=True)
class Glide:
    """One move along or about one axis of the start frame, with zero velocity and acceleration at both ends.

    The path is the fifth-order polynomial of Flash & Hogan 1985, s = 10 u^3 - 15 u^4 + 6 u^5.

    Attributes:
        T_start: pose (4, 4) before the move.
        displacement: (6,) m and rad, one pose component (x, y, z, alpha, beta or gamma) of which is not zero.
        start_s: start of the move.
        duration_s: duration of the move.
    """

    T_start: Array
    displacement: Array
    start_s: float
    duration_s: float

    def pose(self, t_s: float) -> Array:
        """Return T_world_body (4, 4)."""
        u = min(max((t_s - self.start_s) / self.duration_s, 0.0), 1.0)
        return self.T_start @ _offset(self.displacement * (u**3 * (10.0 + u * (-15.0 + 6.0 * u))))

    def twist(self, t_s: float) -> Array:
        """Return (6,) [v, w] along world axes."""
        u = min(max((t_s - self.start_s) / self.duration_s, 0.0), 1.0)
        rate = self.displacement * (30.0 * (u * (1.0 - u)) ** 2 / self.duration_s)
        return _in_world(self.T_start, rate[:3], rate[3:])


@dataclass(frozen=True, slots=True)
class Periodic:
    """Sines in all six pose components of the start frame, with a gentle start.

    Component i is ``amplitude[i] * (sin(phase + shift[i]) - sin(shift[i]))``; the phase's rate rises to 2 pi / period
    within ``ramp_s``, so the body starts from rest at the start pose. Shifts of 0 and 90 degrees in x and y make a
    circle.

    Attributes:
        T_start: pose (4, 4) at time 0.
        amplitude: (6,) of (x, y, z, alpha, beta, gamma), m and rad.
        shift: (6,) rad.
        period_s: period.
        ramp_s: time from its start until full speed.
        start_s: start of the motion.
    """

    T_start: Array
    amplitude: Array
    shift: Array
    period_s: float
    ramp_s: float
    start_s: float = 0.0

    def pose(self, t_s: float) -> Array:
        """Return T_world_body (4, 4)."""
        phase, _ = self._phase(t_s)
        return self.T_start @ _offset(self.amplitude * (np.sin(phase + self.shift) - np.sin(self.shift)))

    def twist(self, t_s: float) -> Array:
        """Return (6,) [v, w] along world axes."""
        phase, rate = self._phase(t_s)
        angles = self.amplitude[3:] * (np.sin(phase + self.shift[3:]) - np.sin(self.shift[3:]))
        velocity = self.amplitude * np.cos(phase + self.shift) * rate
        # Angular velocity of R = Rz(gamma) Ry(beta) Rx(alpha): each rate about its axis, rotated by the later ones.
        Rz, Ry = _turn(2, angles[2]), _turn(1, angles[1])
        w = Rz @ (Ry @ np.array([velocity[3], 0.0, 0.0]) + np.array([0.0, velocity[4], 0.0]))
        w[2] += velocity[5]
        return _in_world(self.T_start, velocity[:3], w)

    def _phase(self, t_s: float) -> tuple[float, float]:
        full_rate = 2.0 * math.pi / self.period_s
        t_s = max(t_s - self.start_s, 0.0)
        if t_s >= self.ramp_s:
            return full_rate * (t_s - 0.5 * self.ramp_s), full_rate
        u = t_s / self.ramp_s
        return full_rate * self.ramp_s * u**3 * (1.0 - 0.5 * u), full_rate * u * u * (3.0 - 2.0 * u)


def _turn(axis: int, angle: float) -> Array:
    sin, cos = math.sin(angle), math.cos(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[j, j] = R[k, k] = cos
    R[j, k], R[k, j] = -sin, sin
    return R


def _offset(pose: Array) -> Array:
    """Return ``se3.from_euler_mm_deg`` in m and rad, without its checks: scenes call it in every step."""
    x, y, z, alpha, beta, gamma = pose.tolist()
    sa, ca, sb, cb = math.sin(alpha), math.cos(alpha), math.sin(beta), math.cos(beta)
    sg, cg = math.sin(gamma), math.cos(gamma)
    return np.array(
        [
            [cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa, x],
            [sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa, y],
            [-sb, cb * sa, cb * ca, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _in_world(T: Array, v: Array, w: Array) -> Array:
    return np.concatenate([T[:3, :3] @ v, T[:3, :3] @ w])
