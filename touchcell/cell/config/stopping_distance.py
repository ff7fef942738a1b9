"""How far an arm may get beyond a limit before it stands: whether a cell's margins fit its speeds, rates and brakes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from touchcell.drivers.core.gate import TwistLimits


@dataclass(frozen=True, slots=True)
class StoppingDistance:
    """The way of a point of the tool from the limit to rest, in the worst case that the arm's gate allows.

    Attributes:
        speed_m_s: of the point, with the arm's fastest turn about its lever.
        cycle_m: until the next control cycle sees it, v / rate.
        latency_m: until the arm hears of it, v * latency.
        braking_m: until it stands, v^2 / 2a, the turn's share likewise.
    """

    speed_m_s: float
    cycle_m: float
    latency_m: float
    braking_m: float

    @property
    def total_m(self) -> float:
        """All of it."""
        return self.cycle_m + self.latency_m + self.braking_m

    def __str__(self) -> str:
        return (
            f"at {1e3 * self.speed_m_s:.0f} mm/s it goes {1e3 * self.cycle_m:.1f} mm in a cycle, "
            f"{1e3 * self.latency_m:.1f} mm in the arm's latency and {1e3 * self.braking_m:.1f} mm to brake, "
            f"{1e3 * self.total_m:.1f} mm in all"
        )


def overshoot(limits: TwistLimits, lever_m: float, rate_hz: float, latency_s: float) -> StoppingDistance:
    """The overshoot of a point ``lever_m`` away from the tool centre point of an arm with these limits."""
    turning_m_s = limits.rot_speed_rad_s * lever_m
    speed_m_s = limits.speed_m_s + turning_m_s
    braking_m = 0.5 * limits.speed_m_s**2 / limits.accel_m_s2
    braking_m += 0.5 * turning_m_s * limits.rot_speed_rad_s / limits.rot_accel_rad_s2
    return StoppingDistance(speed_m_s, speed_m_s / rate_hz, speed_m_s * latency_s, braking_m)


def combined(ways: Sequence[StoppingDistance]) -> StoppingDistance:
    """The overshoot of two points that come towards each other: the sum of theirs."""
    return StoppingDistance(
        sum(way.speed_m_s for way in ways),
        sum(way.cycle_m for way in ways),
        sum(way.latency_m for way in ways),
        sum(way.braking_m for way in ways),
    )
