"""Feedforward and feedback in six dimensions: paper eq. 19 (Lloyd & Lepora 2024, 3.3.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.control.errors import ControlError
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array, ArrayLike

SMOOTHING: Final = 0.5
"""Weight of the newest error in the moving average before the derivative (the paper's decay coefficient)."""


@dataclass(frozen=True, slots=True, eq=False)
class PidGains:
    """Gains and limits, validated once. Vectors become diagonal matrices; all are kept as read-only arrays.

    Attributes:
        kp: proportional gain (6, 6) or its diagonal (6,), 1/s. Row i makes component i of the twist.
        ki: integral gain, likewise, 1/s^2.
        kd: derivative gain, likewise, dimensionless.
        integral_limit: largest magnitude (6,) of each component of the integral term ``ki @ int(e)``, m/s and rad/s.
        integral_zone: an error component (6,) larger than this is not integrated, m and rad (anti-windup): after a step
            of the reference the integral would only cause overshoot. It unwinds an integral of the other sign.
        output_limit: largest magnitude (6,) of each component of the output, feedforward included, m/s and rad/s.

    Raises:
        ControlError: wrong shape, not finite, or a negative limit.
    """

    kp: Array
    ki: Array
    kd: Array
    integral_limit: Array
    integral_zone: Array
    output_limit: Array

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd"):
            gain = _finite(name, getattr(self, name), (6,), (6, 6))
            object.__setattr__(self, name, _frozen(np.diag(gain) if gain.ndim == 1 else gain))
        for name in ("integral_limit", "integral_zone", "output_limit"):
            limit = _finite(name, getattr(self, name), (6,))
            if (limit < 0.0).any():
                raise ControlError(name, "has a negative component", limit)
            object.__setattr__(self, name, _frozen(limit))

    @property
    def controlled(self) -> NDArray[np.bool_]:
        """(6,) bool: components of the twist with feedback, that is with a non-zero gain row."""
        return np.asarray((self.kp != 0.0).any(axis=1) | (self.ki != 0.0).any(axis=1) | (self.kd != 0.0).any(axis=1))


class Pid:
    """``V = V_ff + Kp e + Ki int(e) + Kd de/dt``, backward Euler.

    The error is smoothed by an exponentially weighted average before it is differentiated. The integral *term* is
    accumulated and clipped, in m/s and rad/s: with constant gains that equals the paper's clipped integral. Errors
    outside the integral zone can only unwind the integral; what would drive a clipped output farther beyond its limit
    is not integrated.
    After ``reset`` the first step has no derivative and no history, so it starts without a kick.
    """

    def __init__(self, gains: PidGains) -> None:
        self._gains = gains
        self._differentiates = bool(gains.kd.any())
        self.reset()

    def reset(self) -> None:
        """Clear the integral, the derivative and the error history."""
        self._integral = np.zeros(6)
        self._smoothed: Array | None = None
        self._clipped: NDArray[np.bool_] = np.zeros(6, dtype=bool)

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """(6,) bool: components of the latest output that their limit has cut."""
        return self._clipped

    @property
    def integral(self) -> Array:
        """Current integral term, (6,) m/s and rad/s."""
        return self._integral.copy()

    def step(self, e: Array, V_ff: Array, dt_s: float) -> Array:
        """Return the twist (6,) for error ``e`` (6,) and feedforward ``V_ff`` (6,), ``dt_s`` after the previous step.

        Raises:
            ControlError: an argument is not finite or of the wrong shape, or ``dt_s`` is not positive. The state is
                then
                unchanged.
        """
        e = _finite("e", e, (6,))
        V_ff = _finite("V_ff", V_ff, (6,))
        if not (math.isfinite(dt_s) and dt_s > 0.0):
            raise ControlError("dt_s", f"is {dt_s}, not a positive time", dt_s)
        gains = self._gains
        before = e if self._smoothed is None else self._smoothed
        with np.errstate(over="ignore", invalid="ignore"):
            smoothed = SMOOTHING * e + (1.0 - SMOOTHING) * before
            near = np.abs(e) <= gains.integral_zone
            step = gains.ki @ (e * near) * dt_s
            if not near.all():
                # Otherwise a wound-up integral would balance a constant error outside the zone for good.
                far = gains.ki @ (e * ~near) * dt_s
                step = step + np.where(far * self._integral < 0.0, _clipped(far, np.abs(self._integral)), 0.0)
            integral = _clipped(self._integral + step, gains.integral_limit)
            rest = V_ff + gains.kp @ e
            if self._differentiates:
                rest = rest + gains.kd @ ((smoothed - before) / dt_s)
            output = rest + integral
            beyond = np.abs(output) > gains.output_limit
            limited = any(beyond.tolist())
            if limited:
                # Conditional integration: what would push a clipped component farther beyond its limit is not added.
                winding = beyond & ((integral - self._integral) * output > 0.0)
                integral = np.where(winding, self._integral, integral)
                output = rest + integral
        if not all_finite(output):
            raise ControlError("e", "is so large that the output overflows", e)
        self._smoothed = smoothed
        self._integral = integral
        self._clipped = np.abs(output) > gains.output_limit if limited else beyond
        return _clipped(output, gains.output_limit) if limited else output


def _finite(name: str, value: ArrayLike, *shapes: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape not in shapes:
        raise ControlError(name, f"has shape {array.shape}, not {' or '.join(map(str, shapes))}", value)
    if not all_finite(array):
        raise ControlError(name, "is not finite", value)
    return array


def _clipped(array: Array, limit: Array) -> Array:
    # np.clip is several times slower on arrays this small.
    return np.minimum(np.maximum(array, -limit), limit)


def _frozen(array: Array) -> Array:
    array.flags.writeable = False
    return array
