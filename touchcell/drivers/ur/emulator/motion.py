"""Motions of the emulated UR arm: each returns the joint angles one control period later."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.geometry import se3
from touchcell.geometry.types import Array


class ArmState:
    """State of joints and tool.

    Attributes:
        q, qd: joint angles and speeds (6,).
        T_flange_tcp: tool offset.
        T_base_tcp, J, twist: pose, Jacobian and [v, w] of the tool centre point along base axes.
        model: lengths of the arm.
    """

    def __init__(self, q: Array, model: ur_model.Model = ur_model.UR5E) -> None:
        self.model = model
        self.q = q.copy()
        self.qd = np.zeros(ur_model.JOINTS)
        self.T_flange_tcp = np.eye(4)
        self.travel_m = 0.0
        self.refresh()

    def refresh(self) -> None:
        """Recompute the tool pose from the joints."""
        self.T_base_tcp, self.J = ur_model.forward(self.q, self.T_flange_tcp, self.model)
        self.twist = self.J @ self.qd

    def move_to(self, q: Array, dt_s: float) -> None:
        """Move to ``q`` within one period."""
        moved = self.qd.any() or not np.array_equal(q, self.q)
        self.qd = (q - self.q) / dt_s
        self.q = q
        if moved:
            before = self.T_base_tcp[:3, 3]
            self.refresh()
            self.travel_m += float(np.linalg.norm(self.T_base_tcp[:3, 3] - before))


class Motion(Protocol):
    """A motion of the arm."""

    done: bool

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        """Return joint angles (6,) after ``dt_s``, slowed by the speed slider's ``scaling``."""
        ...


class SpeedL:
    """Tool twist along base axes, reached with bounded acceleration and held until replaced."""

    def __init__(self, arm: ArmState) -> None:
        self.done = False
        self._now = arm.twist.copy()
        self.target = self._now
        self.accel = 0.0

    def aim(self, target: Array, accel: float) -> None:
        """Accelerate towards ``target`` at ``accel`` m/s2 and rad/s2."""
        self.target, self.accel = target, accel

    @property
    def reached(self) -> bool:
        """Return whether the target twist has been reached."""
        return bool(np.array_equal(self._now, self.target))

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        step = self.accel * dt_s
        self._now = np.concatenate(
            [approach(self._now[:3], self.target[:3], step), approach(self._now[3:], self.target[3:], step)]
        )
        return arm.q + ur_model.joint_speeds(arm.J, self._now * scaling) * dt_s


class SpeedJ:
    """Joint speeds, reached with bounded acceleration and held until replaced."""

    def __init__(self, arm: ArmState) -> None:
        self.done = False
        self._now = arm.qd.copy()
        self.target = self._now
        self.accel = 0.0

    def aim(self, target: Array, accel: float) -> None:
        """Accelerate towards ``target`` at ``accel`` rad/s2."""
        self.target, self.accel = target, accel

    @property
    def reached(self) -> bool:
        """Return whether the target speeds have been reached."""
        return bool(np.array_equal(self._now, self.target))

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        self._now = approach(self._now, self.target, self.accel * dt_s)
        return arm.q + self._now * scaling * dt_s


class ServoJ:
    """Follow a joint target with a first-order lag, and stay there."""

    def __init__(self, target: Array, lag_s: float) -> None:
        self.done = False
        self.target, self.lag_s = target, lag_s

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        return np.asarray(arm.q + (self.target - arm.q) * min(1.0, scaling * dt_s / self.lag_s))


class Brake:
    """Decelerate along the present direction to standstill.

    Args:
        decel: m/s2 of the tool where ``linear`` (stopl), else rad/s2 of the fastest joint (stopj).
    """

    def __init__(self, decel: float, *, linear: bool) -> None:
        self.done = False
        self._decel, self._linear = decel, linear

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        fastest = (
            max(float(np.linalg.norm(arm.twist[:3])), float(np.linalg.norm(arm.twist[3:])))
            if self._linear
            else float(np.abs(arm.qd).max())
        )
        left = fastest - self._decel * dt_s
        self.done = left <= 0.0
        return arm.q if self.done else arm.q + arm.qd * (left / fastest) * dt_s


class Trapezoid:
    """Profile from 0 to ``distance`` with bounded speed and acceleration."""

    def __init__(self, distance: float, speed: float, accel: float) -> None:
        self.distance = distance
        self._speed = min(speed, math.sqrt(accel * distance)) if distance > 0.0 else speed
        self._accel = accel
        self._ramp_s = self._speed / accel
        self.duration_s = 2.0 * self._ramp_s + max(0.0, distance / self._speed - self._ramp_s)

    def at(self, t_s: float) -> float:
        """Return the distance covered after ``t_s``."""
        if t_s >= self.duration_s:
            return self.distance
        left_s = self.duration_s - t_s
        if t_s < self._ramp_s:
            return 0.5 * self._accel * t_s**2
        if left_s < self._ramp_s:
            return self.distance - 0.5 * self._accel * left_s**2
        return self._speed * (t_s - 0.5 * self._ramp_s)


class MoveJ:
    """Move in a straight line in joint space; all joints arrive together."""

    def __init__(self, arm: ArmState, target: Array, speed: float, accel: float) -> None:
        self._start, self._target = arm.q.copy(), target
        self._profile = Trapezoid(float(np.abs(target - arm.q).max()), speed, accel)
        self._t_s = 0.0
        self.done = self._profile.distance == 0.0

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        self._t_s += dt_s * scaling
        covered = self._profile.at(self._t_s)
        if covered >= self._profile.distance:
            self.done = True
            return self._target
        return np.asarray(self._start + (self._target - self._start) * (covered / self._profile.distance))


class MoveL:
    """Move the tool centre point on a straight line, the orientation by the shortest rotation."""

    def __init__(self, arm: ArmState, T_target: Array, speed: float, accel: float) -> None:
        self._start = arm.T_base_tcp.copy()
        self._line = T_target[:3, 3] - self._start[:3, 3]
        self._turn = ur_model.rotation_vector(T_target[:3, :3] @ self._start[:3, :3].T)
        distance = max(float(np.linalg.norm(self._line)), float(np.linalg.norm(self._turn)))
        self._profile = Trapezoid(distance, speed, accel)
        self._t_s = 0.0
        self.done = distance < 1e-12

    def advance(self, arm: ArmState, dt_s: float, scaling: float) -> Array:
        self._t_s += dt_s * scaling
        covered = self._profile.at(self._t_s)
        self.done = covered >= self._profile.distance
        fraction = 1.0 if self.done else covered / self._profile.distance
        T = np.asarray(se3.exp(np.concatenate([np.zeros(3), self._turn * fraction])))
        T[:3, :3] = T[:3, :3] @ self._start[:3, :3]
        T[:3, 3] = self._start[:3, 3] + self._line * fraction
        q = ur_model.inverse(T, arm.q, arm.T_flange_tcp, arm.model)
        if q is None:
            self.done = True
            return arm.q
        return q


def approach(now: Array, target: Array, step: float) -> Array:
    """Return ``now`` moved towards ``target`` by at most ``step`` in norm; arrives exactly."""
    gap = target - now
    distance = float(np.linalg.norm(gap))
    return target if distance <= step else now + gap * (step / distance)
