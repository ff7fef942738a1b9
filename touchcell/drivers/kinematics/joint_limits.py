"""Joint limits as pure functions: position and speed, acceleration, and distance to a singularity.

Each limit is directional: it slows motion towards the limit and leaves motion away from it free. The command gate
(``touchcell.drivers.core.gate``) and the setpoints of joint-controlled arms use them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry.types import Array

NEGLIGIBLE = 1e-6
"""Numerical tolerance, in rad/s or m/s: a smaller outward velocity at a limit must not stop the whole arm."""


@dataclass(frozen=True, slots=True)
class IkSettings:
    """Settings of differential inverse kinematics and of the slow-down near joint limits and singularities.

    Attributes:
        characteristic_length_m: length that makes one radian comparable to metres; about half the arm's reach makes the
            singular values comparable.
        singular_value_m: directions with a smaller singular value are damped, and approached slowly.
        singular_floor_m: motion that would reduce the smallest singular value below this is refused.
        leaving_fraction: below the floor, motion away from the singularity may use this fraction of the joint speeds.
        damping_m: largest damping, reached at a singular value of zero; it bounds the joint speed per tool speed. Zero
            for arms whose own controller inverts the twist exactly.
        singular_gain_hz: the distance to the floor shrinks by at most this fraction per second.
        limit_margin_rad: within this distance of a limit the outward speed falls linearly to zero; inward motion is
            free.
        uses_null_space: whether a redundant arm compensates with other joints when one reaches its limit.
    """

    characteristic_length_m: float = 0.25
    singular_value_m: float = 0.04
    singular_floor_m: float = 0.02
    leaving_fraction: float = 0.1
    damping_m: float = 0.04
    singular_gain_hz: float = 10.0
    limit_margin_rad: float = np.deg2rad(5.0)
    uses_null_space: bool = True


def speed_bounds(q: Array, lower: Array, upper: Array, speed: Array, margin_rad: float) -> tuple[Array, Array]:
    """Return the lowest and highest joint speeds (n,) rad/s allowed at ``q`` (n,) rad; zero is always allowed.

    Over the last ``margin_rad`` before a limit the speed towards it falls linearly to zero; beyond it only the way back
    is allowed.
    """
    rate = speed / margin_rad
    highest = np.minimum(np.maximum(rate * (upper - q), 0.0), speed)
    lowest = np.maximum(np.minimum(rate * (lower - q), 0.0), -speed)
    return lowest, highest


def within_bounds(
    dq: Array, lowest: Array, highest: Array, names: tuple[str, ...]
) -> tuple[float, tuple[Adjustment, ...]]:
    """Return the fraction of the joint velocities ``dq`` (n,) rad/s that keeps each in its bounds, and the limit."""
    allowed = np.clip(dq, lowest, highest)
    over = np.abs(allowed - dq) > NEGLIGIBLE
    if not over.any():
        return 1.0, ()
    scale = np.where(over, allowed / np.where(over, dq, 1.0), 1.0)
    worst = int(np.argmin(scale))
    return float(scale[worst]), (Adjustment(f"joint {names[worst]}", float(dq[worst]), float(allowed[worst])),)


def within_acceleration(ddq: Array, accel: Array, names: tuple[str, ...]) -> tuple[float, tuple[Adjustment, ...]]:
    """Return the fraction of the joint accelerations ``ddq`` (n,) rad/s2 within ``accel`` (n,), and the limit."""
    excess = np.abs(ddq) / accel
    worst = int(np.argmax(excess))
    if excess[worst] <= 1.0:
        return 1.0, ()
    found = Adjustment(f"joint {names[worst]} acceleration", float(abs(ddq[worst])), float(accel[worst]))
    return 1.0 / float(excess[worst]), (found,)


def off_singularity(
    smallest_m: float, closing_m_s: float, fastest: float, settings: IkSettings
) -> tuple[float, tuple[Adjustment, ...]]:
    """Return the fraction of a motion that is allowed near a singularity, and the limit.

    Args:
        smallest_m: smallest singular value of the Jacobian with its angular rows times the characteristic length.
        closing_m_s: rate at which the motion decreases it.
        fastest: largest joint speed of the motion as a fraction of that joint's limit.
        settings: thresholds.
    """
    allowed_m_s = settings.singular_gain_hz * max(smallest_m - settings.singular_floor_m, 0.0)
    if closing_m_s > allowed_m_s + NEGLIGIBLE:
        return allowed_m_s / closing_m_s, (Adjustment("singularity", closing_m_s, allowed_m_s),)
    if smallest_m < settings.singular_floor_m and fastest > settings.leaving_fraction:
        return settings.leaving_fraction / fastest, (
            Adjustment("leaving a singularity", fastest, settings.leaving_fraction),
        )
    return 1.0, ()
