"""How a driver's device behaves, as far as a simulation can show it: a table that the driver keeps beside itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class ArmBehaviour:
    """Behaviour of an arm.

    Attributes:
        state_rate_hz: rate of new states.
        latency_s: time from a command to the motion that it causes.
        home_deg: joint angles at which it starts where no start pose is given.
        stop_accel_m_s2: linear deceleration of a stop and of an expired command; None for that of its limits.
        stop_rot_accel_rad_s2: angular deceleration, likewise.
        max_state_age_s: oldest pose with which a twist along tool axes is turned to base axes.
        watchdog_s: silence after which the device stops by itself; None if only the time-to-live stops it.
    """

    state_rate_hz: float
    latency_s: float
    home_deg: tuple[float, ...]
    stop_accel_m_s2: float | None = None
    stop_rot_accel_rad_s2: float | None = None
    max_state_age_s: float = 0.1
    watchdog_s: float | None = None


@dataclass(frozen=True, slots=True)
class CameraBehaviour:
    """Behaviour of a camera.

    Attributes:
        rate_hz: frames per second.
        latency_s: time from the exposure to the delivery of a frame.
        width_px, height_px: picture size.
        color: whether images are BGR (height, width, 3), not grey (height, width).
    """

    rate_hz: float
    latency_s: float
    width_px: int
    height_px: int
    color: bool = False


Behaviour: TypeAlias = ArmBehaviour | CameraBehaviour
