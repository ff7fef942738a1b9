"""Whether what is touched is still the standing object that was touched before.

An object that leans shows in the normal of its side: it turns up or down with it, whatever the model's error, which is
the same before and after. One that falls leaves the tip, and lies farther on; there it can be touched and pushed as if
it stood, with its middle somewhere else. Objects at rest stay where they are, so one that is touched anew far beyond
where it was last felt has fallen, rolled or been moved.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from touchcell.geometry.types import Array

LEAN_DEG: Final = 6.0
"""Turn of the normal out of the plane of the table: noise and load make less than 2 deg, and falls begin at 12."""
_LEANS_S: Final = 0.1
_FARTHER_M: Final = 0.02
"""Distance beyond the last contact: what is lost at 100 mm/s is pushed on by 11 mm while the arm stops."""


class Standing:
    """Watch over the object of one pushing sensor; ``sensor`` is its role."""

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._felt: tuple[Array, Array] | None = None
        self._upright: float | None = None
        self._leans_s = 0.0

    def let_go(self) -> None:
        """Forget the contact: the next one is made elsewhere on purpose."""
        self._felt = None

    def begin_approach(self) -> None:
        """Take note that the object is to be touched anew, as it stands then."""
        self._upright = None

    def changed(self, dt_s: float, T_base_sensor: Array, T_s_f: Array) -> str:
        """Return what shows that the object no longer stands where it stood; empty while nothing does.

        Args:
            dt_s: time since the last call.
            T_base_sensor: (4, 4) pose of the sensor, in a base whose z axis is upright.
            T_s_f: (4, 4) contact.
        """
        normal = T_base_sensor[:3, :3] @ T_s_f[:3, 2]
        raised = math.asin(min(max(float(normal[2]), -1.0), 1.0))
        point = T_base_sensor[:3, :3] @ T_s_f[:3, 3] + T_base_sensor[:3, 3]
        anew, felt = self._upright is None, self._felt
        self._felt = point, normal
        if self._upright is None:
            self._upright = raised
        if anew and felt is not None and (farther_m := float((point - felt[0]) @ felt[1])) > _FARTHER_M:
            return (
                f"{self._sensor} touches {1e3 * farther_m:.0f} mm beyond where it lost contact: the object has fallen, "
                "rolled or been moved"
            )
        lean = raised - self._upright
        self._leans_s = self._leans_s + dt_s if abs(lean) > math.radians(LEAN_DEG) else 0.0
        if self._leans_s > _LEANS_S:
            return f"what {self._sensor} touches leans by {np.degrees(abs(lean)):.0f} deg: the object topples"
        return ""
