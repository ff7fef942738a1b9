"""Track an object: hold the contact while the object moves (paper 5, object tracking)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import PositiveFloat

from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import SixGains
from touchcell.tasks.interface import DEPTH
from touchcell.tasks.planned_motions import PlannedRide
from touchcell.tasks.servoing import ServoConfig, one_arm_task, servo_motions


class ObjectTrackingConfig(ServoConfig):
    """Parameters of object tracking. All six components are controlled.

    Attributes:
        depth_mm: indentation to hold, normal to the surface and without shear.
        duration_s: duration of the tracking.
    """

    depth_mm: Annotated[PositiveFloat, DEPTH] = 6.0
    settle_tolerance_mm: PositiveFloat = 1.0
    settle_tolerance_deg: PositiveFloat = 3.0
    kp_per_s: SixGains = (10.0, 10.0, 10.0, 8.0, 8.0, 8.0)
    ki_per_s2: SixGains = (25.0, 25.0, 25.0, 16.0, 16.0, 16.0)
    duration_s: PositiveFloat = 30.0


class Track:
    """Behavior of object tracking: no feedforward, until the time is over."""

    def __init__(self, config: ObjectTrackingConfig) -> None:
        self._left_s = config.duration_s
        self._timeout_s = config.duration_s + 1.0

    @property
    def feedforward(self) -> Array:
        """Zero twist (6,): the object leads."""
        return np.zeros(6)

    @property
    def timeout_s(self) -> float:
        """Duration plus one second."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Return True once the duration has passed."""
        self._left_s -= dt_s
        return self._left_s <= 0.0

    def shortfall(self) -> str:
        """Return nothing: it finishes when its time is over."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return no further telemetry."""
        return {}


SPEC = one_arm_task(
    "object_tracking",
    "keep contact with an object and follow its motion in all six components",
    ObjectTrackingConfig,
    Track,
    lambda config: (0.0, 0.0, config.depth_mm, 0.0, 0.0, 0.0),
    motions=lambda config, start, mount: (*servo_motions(config), PlannedRide(("duration_s",), config.duration_s)),
)
