"""Generate joint setpoints from expiring twists or joint goals, for position-controlled motors.

The setpoint integrates from its own last value, never from a measurement, so a loaded or noisy arm does not creep.
Whenever a motion ends (stop, expired twist, new goal), the setpoint first decelerates within the acceleration limits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.drivers.kinematics.chain import DifferentialIk, SerialChain
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class _Twist:
    twist: Array
    expires_ns: int


@dataclass(frozen=True, slots=True)
class _Goal:
    q: Array
    speed_fraction: float


class JointSetpoint:
    """Position and velocity setpoint of the joints.

    One thread calls ``step``; the other methods may be called from any thread and take effect at the next step.

    Args:
        chain: kinematic chain of the arm.
        ik: converts twists into joint velocities within joint limits.
        limits: speed and acceleration limits of the tool centre point, for twists and for joint goals.
        stopping: the limits while a twist ends by a stop or by expiry; ``limits`` if None.

    Attributes:
        q, dq: the setpoint (n,) rad and its velocity (n,) rad/s.
        twist: (6,) along base axes that the setpoint follows now; zero while moving to a joint goal.
        adjustments: limits that are active now.
    """

    def __init__(
        self, chain: SerialChain, ik: DifferentialIk, limits: TwistLimits, stopping: TwistLimits | None = None
    ) -> None:
        self._stopping = stopping or limits
        self._chain = chain
        self._ik = ik
        self._limits = limits
        self.reset(np.zeros(chain.joint_count))

    def reset(self, q: Array) -> None:
        """Set the setpoint to ``q`` (n,) rad, at rest."""
        self._task: _Twist | _Goal | None = None
        self.q = np.array(q, dtype=np.float64)
        self.dq = np.zeros_like(self.q)
        self.adjustments: tuple[Adjustment, ...] = ()
        self.twist = np.zeros(6)
        # Joint goals are straight lines in joint space; speed along the line, rad/s.
        self._line = np.zeros_like(self.q)
        self._line_speed = 0.0

    @property
    def moving(self) -> bool:
        """True if the setpoint moves or is about to move."""
        return bool(self.dq.any()) or isinstance(self._task, _Goal)

    def follow(self, twist: Array, expires_ns: int) -> None:
        """Follow ``twist`` (6,) along base axes until ``expires_ns``, then decelerate and hold."""
        self._task = _Twist(np.array(twist, dtype=np.float64), expires_ns)

    def go_to(self, q: Array, speed_fraction: float) -> None:
        """Move to ``q`` (n,) rad in a straight line in joint space at ``speed_fraction`` of the joint speeds."""
        self._task = _Goal(np.array(q, dtype=np.float64), speed_fraction)

    def stop(self) -> None:
        """Decelerate and hold."""
        self._task = None

    def snapshot(self) -> Callable[[int], None]:
        """Return a function that restores setpoint and motion, given the nanoseconds elapsed since."""
        kept = self._task, self.q, self.dq, self.adjustments, self.twist, self._line, self._line_speed

        def restore(later_ns: int) -> None:
            task, self.q, self.dq, self.adjustments, self.twist, self._line, self._line_speed = kept
            self._task = replace(task, expires_ns=task.expires_ns + later_ns) if isinstance(task, _Twist) else task

        return restore

    def step(self, now_ns: int, dt_s: float) -> tuple[Array, Array]:
        """Advance by ``dt_s``; return the setpoint (n,) rad and its velocity (n,) rad/s."""
        task = self._task
        on_line = self._line_speed > 0.0
        if isinstance(task, _Goal) and not self.twist.any():
            self._step_to_goal(task, dt_s)
        elif on_line:
            self._slow_on_line(dt_s)
        else:
            wanted = task.twist if isinstance(task, _Twist) and now_ns < task.expires_ns else np.zeros(6)
            self._step_by_twist(wanted, dt_s)
        self.q = self.q + self.dq * dt_s
        return self.q, self.dq

    def _step_by_twist(self, wanted: Array, dt_s: float) -> None:
        limits = self._limits if wanted.any() else self._stopping
        twist = np.concatenate(
            [
                _towards(self.twist[:3], wanted[:3], limits.accel_m_s2 * dt_s),
                _towards(self.twist[3:], wanted[3:], limits.rot_accel_rad_s2 * dt_s),
            ]
        )
        if not twist.any():
            self.twist = twist
            self.dq = np.zeros_like(self.q)
            self.adjustments = ()
            return
        # Solved at the joint angles half a step ahead, so that drift on a curved path is of second order only.
        motion = self._ik.solve(self.q + 0.5 * dt_s * self.dq, twist)
        self.dq = motion.dq
        self.adjustments = motion.adjustments
        # A motion slowed by a limit continues from its actual speed.
        self.twist = motion.twist if motion.adjustments else twist

    def _step_to_goal(self, goal: _Goal, dt_s: float) -> None:
        way = goal.q - self.q
        distance = float(np.linalg.norm(way))
        if distance < 1e-9:
            self._end_line()
            if self._task is goal:
                self._task = None
            return
        direction = way / distance
        if self._line_speed > 0.0 and float(direction @ self._line) < 0.999:
            self._slow_on_line(dt_s)
            return
        self._line = direction
        speed, acceleration = self._line_limits(goal.speed_fraction)
        braking = float(np.sqrt(2.0 * acceleration * distance))
        self._line_speed = min(self._line_speed + acceleration * dt_s, speed, braking, distance / dt_s)
        self.dq = direction * self._line_speed

    def _slow_on_line(self, dt_s: float) -> None:
        _, acceleration = self._line_limits(1.0)
        self._line_speed = max(self._line_speed - acceleration * dt_s, 0.0)
        if self._line_speed == 0.0:
            self._end_line()
        else:
            self.dq = self._line * self._line_speed

    def _end_line(self) -> None:
        self._line_speed = 0.0
        self.dq = np.zeros_like(self.q)

    def _line_limits(self, speed_fraction: float) -> tuple[float, float]:
        """Return speed and acceleration along the line that keep joints and tool centre point within their limits."""
        tool = self._chain.jacobian(self.q) @ self._line
        linear, angular = float(np.linalg.norm(tool[:3])), float(np.linalg.norm(tool[3:]))
        limits = self._limits
        tiny = 1e-9
        joint_speed = speed_fraction * float(np.min(self._chain.speed / np.maximum(np.abs(self._line), tiny)))
        speed = min(joint_speed, limits.speed_m_s / max(linear, tiny), limits.rot_speed_rad_s / max(angular, tiny))
        acceleration = min(limits.accel_m_s2 / max(linear, tiny), limits.rot_accel_rad_s2 / max(angular, tiny))
        return speed, acceleration


def _towards(current: Array, wanted: Array, max_step: float) -> Array:
    step = wanted - current
    length = float(np.linalg.norm(step))
    return wanted if length <= max_step else current + step * (max_step / length)
