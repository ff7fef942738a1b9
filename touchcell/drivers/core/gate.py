"""The last check before an arm: finite, shape, frame, lease, mode, freshness, limits, in that order.

``min``, ``max`` and ``np.clip`` turn NaN into full speed or let it pass, so whatever is not finite is refused before
any limit is applied, and what comes out is checked once more before it may be sent. Acceleration and jerk are those of
one command after another, never of the measured state; where the joints are is measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.command_checks import checked_twist_command
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame, in_base_axes, read_only
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, Rejection
from touchcell.drivers.core.lease import Lease, LeaseManager
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.drivers.kinematics.chain import LocalIk


@dataclass(frozen=True, slots=True)
class TwistLimits:
    """Largest speeds, accelerations and jerks of the tool centre point (norms of the linear and the angular part)."""

    speed_m_s: float
    accel_m_s2: float
    rot_speed_rad_s: float
    rot_accel_rad_s2: float
    jerk_m_s3: float
    rot_jerk_rad_s3: float


Follow = Callable[[Array], tuple[Array, tuple[Adjustment, ...]]]
"""What an arm can follow of a twist (6,) along base axes, and why that differs."""


def _follow_all(twist: Array) -> tuple[Array, tuple[Adjustment, ...]]:
    return twist, ()


def _no_joints() -> LocalIk | None:
    return None


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
        self, device: str, limits: TwistLimits, desk: LeaseManager, clock: Clock, *, max_ttl_s: float = 1.0
    ) -> None:
        self._device = device
        self._limits = limits
        self._accels = limits.accel_m_s2, limits.rot_accel_rad_s2
        self._jerks = limits.jerk_m_s3, limits.rot_jerk_rad_s3
        self._desk = desk
        self._clock = clock
        self._max_ttl_s = max_ttl_s
        self.reset()

    def reset(self) -> None:
        """Forget the last command: the next one is limited as if from rest."""
        self._last = self._last_accel = _REST
        # Earlier than any time.
        self._last_ns = self._expires_ns = -1

    def admit(
        self,
        command: TwistCommand,
        lease: Lease,
        state: Lifecycle,
        T_base_tcp: Array,
        follow: Follow = _follow_all,
        joints: Callable[[], LocalIk | None] = _no_joints,
    ) -> Sent[TwistCommand]:
        """Refuse the command or return what may be sent, along base axes, with every adjustment named.

        Args:
            command: what is asked for.
            lease: of the caller.
            state: of the arm.
            T_base_tcp: (4, 4) for commands along tool axes.
            follow: asked first what the arm can follow at all.
            joints: returns the joint positions, called once the command is found fit; None: they are not limited here.

        Raises:
            CommandRejected: with the first reason that applies; nothing may be sent.
        """
        now_ns = self._clock.now_ns()
        command = self._checked(command, lease, state, now_ns)
        wanted, lost = follow(in_base_axes(command, T_base_tcp))
        adjustments = list(lost)
        if now_ns > self._expires_ns:
            # After a silence longer than the time-to-live the arm stands: limit from rest. When the next command will
            # come is not known, and the time-to-live is much longer than a cycle.
            self._last = self._last_accel = _REST
            dt_s = min(command.ttl_s, FIRST_STEP_S)
        else:
            dt_s = min(command.ttl_s, (now_ns - self._last_ns) * 1e-9)
        # A time-to-live may be as short as the smallest positive number, and is divided by.
        dt_s = max(dt_s, _SHORTEST_STEP_S)
        local = joints()
        wanted = self._limited(wanted, adjustments)
        if local is not None:
            wanted = _within(local, wanted, adjustments)
        step = self._step(wanted - self._last, dt_s, adjustments)
        if local is not None:
            share, why = local.acceleration_scale(step, dt_s)
            step = share * step
            adjustments.extend(why)
        # Nothing that smoothes a motion may carry it over the limits that end it.
        allowed = self._limited(self._last + step, adjustments)
        if local is not None:
            allowed = _within(local, allowed, adjustments)
        allowed = read_only(allowed)
        self._check_output(allowed)
        self._last_accel = (allowed - self._last) / dt_s
        self._last = allowed
        self._last_ns = now_ns
        self._expires_ns = now_ns + round(command.ttl_s * 1e9)
        sent = TwistCommand(allowed, TwistFrame.BASE, command.t_ns, command.ttl_s, command.t_cause_ns)
        return Sent(sent, now_ns, tuple(adjustments))

    def _step(self, way: Array, dt_s: float, adjustments: list[Adjustment]) -> Array:
        """Change of the twist within ``dt_s`` on the ``way`` (6,) to the wanted one.

        The acceleration points along the way, as large as allowed and as can still be taken off before the way ends; it
        changes by no more than the jerk allows.
        """
        last, accels, jerks = self._last_accel, self._accels, self._jerks
        lefts = _norms(way)
        rate = smooth = 1.0 / dt_s
        for name, left, most, jerk in zip(_PARTS, lefts, accels, jerks, strict=True):
            if left > most * dt_s:
                adjustments.append(Adjustment(f"tcp {name} acceleration", left / dt_s, most))
                rate = min(rate, most / left)
            if left > _NEGLIGIBLE:
                # The largest acceleration that the jerk can take off again before the way ends.
                braked = math.sqrt(2.0 * jerk / left) - 0.5 * jerk * dt_s / left
                smooth = min(smooth, max(braked, min(1.0 / dt_s, jerk * dt_s / left)))
        change = min(rate, smooth) * way - last
        share = 1.0
        for name, left, step, jerk in zip(_PARTS, lefts, _norms(change), jerks, strict=True):
            asked = max(step, rate * left if smooth < rate else 0.0) / dt_s
            if asked > jerk * _ROUNDING:
                adjustments.append(Adjustment(f"tcp {name} jerk", asked, jerk))
            if step > jerk * dt_s:
                share = min(share, jerk * dt_s / step)
        return (last + share * change) * dt_s

    def _limited(self, twist: Array, adjustments: list[Adjustment]) -> Array:
        """``twist`` scaled by one factor so that neither part exceeds its speed; CommandRejected if it is not finite.

        One factor for both parts: scaling them apart would bend the motion of whatever sits on a lever, and a tactile
        sensor that turns about its contact would be torn off it.
        """
        linear, angular = _norms(twist)
        max_linear, max_angular = self._limits.speed_m_s, self._limits.rot_speed_rad_s
        if linear <= max_linear and angular <= max_angular:
            return twist
        self._require_finite(twist)
        scale = 1.0
        for part, size, limit in (("linear", linear, max_linear), ("angular", angular, max_angular)):
            if size > limit * _ROUNDING:
                adjustments.append(Adjustment(f"tcp {part} speed", size, limit))
            if size > limit:
                scale = min(scale, limit / size)
        return twist * scale

    def _checked(self, command: TwistCommand, lease: Lease, state: Lifecycle, now_ns: int) -> TwistCommand:
        """``command`` with values of its own, or the first reason to refuse it."""
        command = checked_twist_command(self._device, command)
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
        age_ns = now_ns - command.t_ns
        if not 0 <= age_ns <= round(1e9 * command.ttl_s):
            raise self._rejected(
                Rejection.EXPIRED, f"computed {age_ns} ns ago, lives {command.ttl_s:g} s", age_ns, command.ttl_s
            )
        return command

    def _check_output(self, twist: Array) -> None:
        """Refuse what must not be sent, whatever has made it: a driver's ``follow``, its kinematics, or its limits."""
        linear, angular = _norms(twist)
        limits = self._limits
        if not (linear <= limits.speed_m_s * _ROUNDING and angular <= limits.rot_speed_rad_s * _ROUNDING):
            self._require_finite(twist)
            raise self._rejected(
                Rejection.LIMIT,
                f"the twist to be sent has {linear:g} m/s and {angular:g} rad/s, above the limits",
                twist,
                (limits.speed_m_s, limits.rot_speed_rad_s),
            )

    def _require_finite(self, twist: Array) -> None:
        if not all_finite(twist):
            raise self._rejected(Rejection.NON_FINITE, "the twist to be sent is not finite", twist)

    def _rejected(self, reason: Rejection, message: str, value: object, limit: object = None) -> CommandRejected:
        return CommandRejected(self._device, reason, message, value=value, limit=limit)


def _within(local: LocalIk, twist: Array, adjustments: list[Adjustment]) -> Array:
    """``twist`` scaled so that no joint exceeds its limits; each joint is named once."""
    _, scale, why = local.limited(twist)
    named = {adjustment.limit for adjustment in adjustments}
    adjustments.extend(adjustment for adjustment in why if adjustment.limit not in named)
    return scale * twist


def _norms(twist: Array) -> tuple[float, float]:
    """Of the linear and of the angular part; NumPy takes longer for numbers this few."""
    x, y, z, a, b, c = twist.tolist()
    return math.sqrt(x * x + y * y + z * z), math.sqrt(a * a + b * b + c * c)


FIRST_STEP_S: Final = 1e-3
"""The time over which a first command from rest may accelerate: the shortest control cycle that a cell may have."""
_REST = read_only(np.zeros(6))
_PARTS = ("linear", "angular")
_NEGLIGIBLE = 1e-12
_SHORTEST_STEP_S = 1e-6
_ROUNDING = 1.0 + 1e-6
