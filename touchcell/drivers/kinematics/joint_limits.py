"""Limits of joints, as pure functions: position and speed, acceleration, and nearness to a singularity.

Each is directional: it holds back what makes things worse and lets through what makes them better. They are used for
what an arm's gate lets through (``touchcell.drivers.core.gate``) and for the setpoints of arms that we drive joint by
joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry.types import Array

NEGLIGIBLE = 1e-6
"""Rounding, in rad/s or m/s: what points outwards at a limit by no more must not stop a whole arm."""


@dataclass(frozen=True, slots=True)
class IkSettings:
    """How twists become joint velocities, and where joints have to slow down.

    Attributes:
        characteristic_length_m: one radian weighs as much as this many metres; about half the arm's reach makes the
            singular values comparable.
        singular_value_m: directions with a smaller singular value are damped, and approached slowly.
        singular_floor_m: motion that would bring the smallest singular value below this is refused.
        leaving_fraction: below the floor, motion away from the singularity may take this share of the joints' speeds.
        damping_m: largest damping, reached at a singular value of zero; it bounds the joint speed per tool speed. Zero
            for arms whose own controller inverts the twist exactly.
        singular_gain_hz: the distance to the floor shrinks by at most this fraction per second.
        limit_margin_rad: over this last stretch a joint's outward speed falls linearly to zero; inward it is free.
        goes_round: whether a redundant arm makes up for a joint at its limit with the others.
    """

    characteristic_length_m: float = 0.25
    singular_value_m: float = 0.04
    singular_floor_m: float = 0.02
    leaving_fraction: float = 0.1
    damping_m: float = 0.04
    singular_gain_hz: float = 10.0
    limit_margin_rad: float = np.deg2rad(5.0)
    goes_round: bool = True


def speed_bounds(q: Array, lower: Array, upper: Array, speed: Array, margin_rad: float) -> tuple[Array, Array]:
    """Slowest and fastest joint speeds (n,) rad/s allowed at ``q`` (n,) rad; standing still always is.

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
    """Share of the joint velocities ``dq`` (n,) rad/s that keeps each in its bounds, and which joint asked for it."""
    allowed = np.clip(dq, lowest, highest)
    over = np.abs(allowed - dq) > NEGLIGIBLE
    if not over.any():
        return 1.0, ()
    scale = np.where(over, allowed / np.where(over, dq, 1.0), 1.0)
    worst = int(np.argmin(scale))
    return float(scale[worst]), (Adjustment(f"joint {names[worst]}", float(dq[worst]), float(allowed[worst])),)


def within_acceleration(ddq: Array, accel: Array, names: tuple[str, ...]) -> tuple[float, tuple[Adjustment, ...]]:
    """Share of the joint accelerations ``ddq`` (n,) rad/s2 that keeps each within ``accel`` (n,), and why."""
    excess = np.abs(ddq) / accel
    worst = int(np.argmax(excess))
    if excess[worst] <= 1.0:
        return 1.0, ()
    found = Adjustment(f"joint {names[worst]} acceleration", float(abs(ddq[worst])), float(accel[worst]))
    return 1.0 / float(excess[worst]), (found,)


def off_singularity(
    smallest_m: float, closing_m_s: float, fastest: float, settings: IkSettings
) -> tuple[float, tuple[Adjustment, ...]]:
    """Share of a motion that may be done near a singularity, and why.

    Args:
        smallest_m: smallest singular value of the Jacobian with its angular rows times the characteristic length.
        closing_m_s: how fast the motion makes it smaller.
        fastest: largest joint speed of the motion as a share of that joint's limit.
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
