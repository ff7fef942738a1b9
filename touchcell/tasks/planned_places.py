"""Places where a task surely takes an arm, as far as its parameters say: `touchcell check` holds them against boxes."""

from __future__ import annotations

from dataclasses import dataclass

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPlace:
    """A place that an arm is sent to, or fails before it is there.

    Attributes:
        key: of the task's parameter that says so.
        arm: role of the arm.
        T_base_tcp: pose (4, 4) of the tool in the base frame of the arm; None to give ``tip_m`` instead.
        tip_m: (3,) place of the sensor's tip in the same frame, NaN along axes where it is not known.
        slack_m: how far from there the arm may stay all the same.
    """

    key: tuple[str | int, ...]
    arm: str
    T_base_tcp: Array | None = None
    tip_m: Array | None = None
    slack_m: float = 0.0

    def point_m(self, T_tcp_point: Array) -> Array:
        """Return the place (3,) of a point of the tool, at ``T_tcp_point`` (4, 4); of the tip, where that is known."""
        if self.T_base_tcp is None:
            assert self.tip_m is not None
            return self.tip_m
        point: Array = (self.T_base_tcp @ T_tcp_point)[:3, 3]
        return point
