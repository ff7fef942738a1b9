"""The last check before an arm: finite, shape, frame, lease, mode, freshness, limits, in that order.

``min``, ``max`` and ``np.clip`` turn NaN into full speed or let it pass, so whatever is not finite is refused before
any limit is applied. Speed and acceleration limits are relative to the last command sent, never to the measured state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from drivers.clock import Clock
from drivers.commands import Adjustment, Sent, TwistCommand, TwistFrame, in_base_axes
from drivers.device import Lifecycle
from drivers.errors import CommandRejected, Rejection
from drivers.lease import Lease, LeaseDesk
from geometry.types import Array


@dataclass(frozen=True, slots=True)
class TwistLimits:
    """Largest speeds and accelerations of the tool centre point (norms of the linear and the angular part)."""

    speed_m_s: float
    accel_m_s2: float
    rot_speed_rad_s: float
    rot_accel_rad_s2: float


class TwistGate:
    """Checks and limits the twists of one arm.

    Args:
        device: name for errors.
        limits: of the tool centre point.
        desk: the arm's lease desk.
        clock: injected time.
        max_ttl_s: longest time-to-live accepted.
    """

    def __init__(
        self, device: str, limits: TwistLimits, desk: LeaseDesk, clock: Clock, *, max_ttl_s: float = 1.0
    ) -> None:
        self._device = device
        self._limits = limits
        self._desk = desk
        self._clock = clock
        self._max_ttl_s = max_ttl_s
        self.reset()

    def reset(self) -> None:
        """Forget the last command: the next one is limited as if from rest."""
        self._last = np.zeros(6)
        self._last_ns = self._clock.now_ns() - round(self._max_ttl_s * 1e9)
        self._expires_ns = self._last_ns

    def admit(self, command: TwistCommand, lease: Lease, state: Lifecycle, T_base_tcp: Array) -> Sent[TwistCommand]:
        """Refuse the command or return what may be sent, along base axes, with every adjustment named.

        Raises:
            CommandRejected: with the first reason that applies; nothing may be sent.
        """
        now_ns = self._clock.now_ns()
        self._check(command, lease, state, now_ns)
        wanted = in_base_axes(command, T_base_tcp)
        adjustments: list[Adjustment] = []
        # After a silence longer than the time-to-live the arm stands: limit from zero.
        previous = self._last if now_ns <= self._expires_ns else np.zeros(6)
        dt_s = min(command.ttl_s, (now_ns - self._last_ns) * 1e-9)
        limits = self._limits
        allowed = _limited(wanted, limits.speed_m_s, limits.rot_speed_rad_s, "speed", adjustments)
        step = _limited(
            allowed - previous,
            limits.accel_m_s2 * dt_s,
            limits.rot_accel_rad_s2 * dt_s,
            "acceleration",
            adjustments,
        )
        allowed = previous + step
        self._last = allowed
        self._last_ns = now_ns
        self._expires_ns = now_ns + round(command.ttl_s * 1e9)
        return Sent(replace(command, twist=allowed, frame=TwistFrame.BASE), now_ns, tuple(adjustments))

    def _check(self, command: TwistCommand, lease: Lease, state: Lifecycle, now_ns: int) -> None:
        twist = np.asarray(command.twist, dtype=np.float64)
        if not (np.isfinite(twist).all() and math.isfinite(command.ttl_s)):
            raise self._rejected(Rejection.NON_FINITE, "twist or time-to-live is not finite", command.twist)
        if twist.shape != (6,):
            raise self._rejected(Rejection.SHAPE, f"twist has shape {twist.shape}, not (6,)", twist.shape, (6,))
        if not isinstance(command.frame, TwistFrame):
            raise self._rejected(Rejection.FRAME, f"unknown frame {command.frame!r}", command.frame)
        self._desk.check(lease)
        if state is not Lifecycle.ACTIVE:
            raise self._rejected(Rejection.MODE, f"device is {state.value}, not active", state)
        if not 0.0 < command.ttl_s <= self._max_ttl_s:
            raise self._rejected(
                Rejection.LIMIT,
                f"time-to-live {command.ttl_s:g} s is not in (0, {self._max_ttl_s:g}]",
                command.ttl_s,
                self._max_ttl_s,
            )
        age_s = (now_ns - command.t_ns) * 1e-9
        if not 0.0 <= age_s <= command.ttl_s:
            raise self._rejected(
                Rejection.EXPIRED,
                f"computed {age_s:.4f} s ago, lives {command.ttl_s:g} s",
                age_s,
                command.ttl_s,
            )

    def _rejected(self, reason: Rejection, message: str, value: object, limit: object = None) -> CommandRejected:
        return CommandRejected(self._device, reason, message, value=value, limit=limit)


def _limited(twist: Array, max_linear: float, max_angular: float, what: str, adjustments: list[Adjustment]) -> Array:
    """``twist`` scaled by one factor so that neither part exceeds its limit.

    One factor for both parts: scaling them apart would bend the motion of whatever sits on a lever, and a tactile
    sensor that turns about its contact would be torn off it.
    """
    scale = 1.0
    for part, vector, limit in (("linear", twist[:3], max_linear), ("angular", twist[3:], max_angular)):
        size = math.sqrt(float(vector @ vector))
        if size > limit:
            adjustments.append(Adjustment(f"tcp {part} {what}", size, limit))
            scale = min(scale, limit / size)
    return twist if scale == 1.0 else twist * scale
