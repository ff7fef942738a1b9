"""Motion of a sensor beside an object that it has let go of: goals, some of which feel for a contact on the way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from touchcell.control.push_steering import Pose
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Goal:
    """Where a sensor shall go.

    Attributes:
        T_base_sensor: (4, 4) its pose there.
        feels: True if it goes no farther than to a contact.
        slow_m: last part of a way that feels, on which it goes slowly: nothing is expected before. All of it by
            default.
        passes: True if it only passes by there, on its way to the next one.
    """

    T_base_sensor: Array
    feels: bool = False
    slow_m: float = math.inf
    passes: bool = False


def heading_of(direction: Array) -> float:
    """Return the angle of a direction (3,) in top view, from the x axis."""
    return math.atan2(float(direction[1]), float(direction[0]))


def placed(T_base_sensor: Array, at: Pose) -> Array:
    """Return the pose (4, 4) of a sensor moved and turned in top view, so that its z axis has the heading there."""
    turn = at.heading - heading_of(T_base_sensor[:3, 2])
    cos, sin = math.cos(turn), math.sin(turn)
    T = T_base_sensor.copy()
    T[:3, :3] = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ T_base_sensor[:3, :3]
    T[:2, 3] = at.x, at.y
    return T
