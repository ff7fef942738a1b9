"""How near an arm that pushes is to what its interlocks allow, so that it gives up instead of being stopped."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.interface import TaskContext

_TILT_RAD: Final = math.radians(3.0)
"""Tilt that is kept to a limit ..."""
_WALL_M: Final = 4e-3
"""... and distance to a wall ..."""
_AHEAD_S: Final = 0.2
"""... where the arm will be this much later ..."""
_DEPTH_M: Final = 0.15e-3
"""... and depth: it grows by this much from frame to frame as an object is pressed at the speed of a start."""
_BLIND_S: Final = 0.2
"""Time for which a deep contact may be beyond what its model measures."""
_DEEP: Final = 0.7
"""Share of the depth's limit from which that is why."""


class PushBounds:
    """Limits of one arm and its sensor.

    Args:
        context: of the cell.
        arm, sensor: their roles.
    """

    def __init__(self, context: TaskContext, arm: str, sensor: str) -> None:
        self._T_sensor_tcp = se3.inverse(context.T_tcp_sensor[sensor])
        self._sensor, self._arm = sensor, arm
        self._boxes, self._cones = context.boxes.get(arm, ()), context.cones.get(arm, ())
        self._max_depth_m, self._max_shear_m = context.max_depth_m, context.max_shear_m
        self._depth_m = 0.0
        self._blind_s = 0.0

    def reached(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> str:
        """Return which limit has nearly been reached; empty while none has.

        Args:
            dt_s: time since the last call.
            before: T_base_sensor (4, 4) one cycle ago.
            now: T_base_sensor (4, 4).
            T_s_f: contact (4, 4); None where it cannot be measured.
        """
        return self._pressed(dt_s, T_s_f) or self._tilted(now) or self._at_wall(dt_s, before, now)

    def _pressed(self, dt_s: float, T_s_f: Array | None) -> str:
        if T_s_f is None:
            self._blind_s += dt_s
            if self._blind_s > _BLIND_S and self._depth_m > _DEEP * self._max_depth_m:
                return (
                    f"{self._sensor} is pressed in too deep to be measured: the object needs more force than it gives"
                )
            return ""
        self._blind_s = 0.0
        self._depth_m = max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
        if self._depth_m > self._max_depth_m - _DEPTH_M:
            return (
                f"{self._sensor} is pressed in by {1e3 * self._depth_m:.2f} mm, limit {1e3 * self._max_depth_m:g} mm: "
                "the object needs more force than it gives"
            )
        shear_m = math.hypot(*(se3.inverse(T_s_f)[:2, 3]))
        if shear_m > self._max_shear_m:
            return f"{self._sensor} is sheared by {1e3 * shear_m:.2f} mm, limit {1e3 * self._max_shear_m:g} mm"
        return ""

    def _tilted(self, now: Array) -> str:
        R_base_tcp = now[:3, :3] @ self._T_sensor_tcp[:3, :3]
        for cone in self._cones:
            tilt = math.acos(min(max(float(R_base_tcp @ cone.axis_tcp @ cone.direction), -1.0), 1.0))
            if tilt > cone.limit_rad - _TILT_RAD:
                return (
                    f"{self._arm} is tilted by {math.degrees(tilt):.1f} deg, limit {math.degrees(cone.limit_rad):g} deg"
                )
        return ""

    def _at_wall(self, dt_s: float, before: Array, now: Array) -> str:
        T_base_tcp = now @ self._T_sensor_tcp
        velocity = (now[:3, 3] - before[:3, 3]) / max(dt_s, 1e-3)
        for box in self._boxes:
            point = T_base_tcp[:3, 3] + T_base_tcp[:3, :3] @ box.lever_m
            later = point + _AHEAD_S * velocity
            moves = np.abs(later - point) > 1e-3
            if bool((moves & ((later > box.max_m - _WALL_M) | (later < box.min_m + _WALL_M))).any()):
                x, y, z = 1e3 * point
                return f"{self._arm} comes to a wall of its workspace at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
        return ""
