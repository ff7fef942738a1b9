"""Move to a pose: a twist towards it that keeps its direction when it has to be limited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Reach:
    """Gain and limits of a move to a pose.

    Attributes:
        gain_per_s: proportional gain near the goal.
        speed_m_s: largest speed of the frame's origin.
        turn_rad_s: largest angular rate.
    """

    gain_per_s: float
    speed_m_s: float
    turn_rad_s: float

    def twist(self, T_base_s: Array, T_base_goal: Array) -> Array:
        """Return the (6,) twist of frame {s}, in {s}, that moves it along a screw to the goal. Raises GeometryError."""
        V = self.gain_per_s * se3.log(se3.compose(se3.inverse(T_base_s), T_base_goal))
        speed, turn = float(np.linalg.norm(V[:3])), float(np.linalg.norm(V[3:]))
        limited: Array = V / max(speed / self.speed_m_s, turn / self.turn_rad_s, 1.0)
        return limited


def is_there(T_base_s: Array, T_base_goal: Array, within_m: float, within_rad: float) -> bool:
    """Return True if a frame is at the goal within the tolerances."""
    away = se3.log(se3.compose(se3.inverse(T_base_s), T_base_goal))
    return bool(np.linalg.norm(away[:3]) <= within_m and np.linalg.norm(away[3:]) <= within_rad)
