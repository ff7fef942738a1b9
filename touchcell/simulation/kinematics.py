"""Kinematics of an ideal arm: a tool centre point that follows expiring twists with limited acceleration."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from touchcell.drivers.core.gate import TwistLimits
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_THREE_HALVES = 1.5 * np.eye(3)
_STANDING = 1e-5
"""m/s and rad/s."""


class TwistFollower:
    """Ideal kinematics: no joints, no dynamics except acceleration limits.

    Args:
        T_base_tcp: start pose (4, 4).
        limits: only the accelerations are used.
        step_ns: length of a step.
        lag_s: time constant with which twists are followed.
        resolution: of the velocity, m/s and rad/s; 0 for any.
    """

    def __init__(
        self,
        T_base_tcp: Array,
        limits: TwistLimits,
        step_ns: int,
        *,
        lag_s: float = 0.0,
        resolution: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.T_base_tcp = T_base_tcp
        self.velocity = np.zeros(6)
        self._limits = limits
        self._step_ns = step_ns
        self._lag_s = lag_s
        self._resolution = resolution
        self._lagging = np.zeros(6)
        self._target = np.zeros(6)
        self._expires_ns = 0

    def follow(self, twist: Array, expires_ns: int) -> None:
        """Follow ``twist`` (6,), along base axes, until ``expires_ns``."""
        self._target = twist.copy()
        for part, step in ((slice(0, 3), self._resolution[0]), (slice(3, 6), self._resolution[1])):
            if step:
                self._target[part] = np.round(self._target[part] / step) * step
        self._expires_ns = expires_ns

    def prolong(self, t_ns: int) -> None:
        """Extend the validity of the present twist at least until ``t_ns``."""
        self._expires_ns = max(self._expires_ns, t_ns)

    def halt(self) -> None:
        """Decelerate to rest."""
        self._target = np.zeros(6)

    def freeze(self) -> None:
        """Stop at once."""
        self.halt()
        self.velocity = np.zeros(6)
        self._lagging = np.zeros(6)

    def at_rest(self) -> bool:
        """True if it neither moves nor is about to."""
        # ndarray.any takes three times as long on arrays this small.
        return not (any(self.velocity.tolist()) or any(self._target.tolist()))

    def snapshot(self) -> Callable[[int], None]:
        """Return a function that restores pose, velocity and command, given the nanoseconds elapsed since."""
        kept = self.T_base_tcp, self.velocity, self._target, self._lagging
        expires_ns = self._expires_ns

        def restore(later_ns: int) -> None:
            self.T_base_tcp, self.velocity, self._target, self._lagging = kept
            self._expires_ns = expires_ns + later_ns

        return restore

    def step(self, t_ns: int) -> None:
        """Move over the step that ends at ``t_ns``."""
        if t_ns - self._step_ns >= self._expires_ns:
            self.halt()
        if self.at_rest():
            return
        dt_s = self._step_ns * 1e-9
        before, goal = self.velocity.tolist(), self._followed(dt_s)
        if before != goal:
            linear = _towards(before[:3], goal[:3], self._limits.accel_m_s2 * dt_s)
            goal = linear + _towards(before[3:], goal[3:], self._limits.rot_accel_rad_s2 * dt_s)
            self.velocity = np.array(goal)
        x, y, z, a, b, c = [0.5 * (old + new) * dt_s for old, new in zip(before, goal, strict=True)]
        T = self.T_base_tcp.copy()
        T[:3, 3] += (x, y, z)
        if a or b or c:
            R = se3.exp(np.array([0.0, 0.0, 0.0, a, b, c]))[:3, :3] @ T[:3, :3]
            # One Newton-Schulz step removes this step's rounding, so that none accumulates; se3.project iterates more.
            T[:3, :3] = R @ (_THREE_HALVES - 0.5 * (R.T @ R))
        self.T_base_tcp = T

    def _followed(self, dt_s: float) -> list[float]:
        """Return the twist that the arm follows after ``dt_s`` more: late by a first-order lag."""
        goal: list[float] = self._target.tolist()
        if not self._lag_s:
            return goal
        lagging = self._lagging + (self._target - self._lagging) * (1.0 - math.exp(-dt_s / self._lag_s))
        # An exponential never arrives: below this the arm stands.
        if not self._target.any() and float(np.abs(lagging).max()) < _STANDING:
            lagging = np.zeros(6)
        self._lagging = lagging
        goal = lagging.tolist()
        return goal


def _towards(start: list[float], goal: list[float], longest: float) -> list[float]:
    """Return ``start`` moved towards ``goal`` by at most ``longest``."""
    (x0, y0, z0), (x1, y1, z1) = start, goal
    x, y, z = x1 - x0, y1 - y0, z1 - z0
    length = math.sqrt(x * x + y * y + z * z)
    if length <= longest:
        return goal
    share = longest / length
    return [x0 + x * share, y0 + y * share, z0 + z * share]
