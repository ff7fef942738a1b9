"""Follow a surface: slide over it at constant depth, normal to it (paper 5, surface following).

Either in one direction of the sensor, as in the paper, or along a planned path that is projected onto the surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import PositiveFloat

from touchcell.control.curvature import CurvatureEstimator
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import SixGains
from touchcell.tasks.interface import DEPTH, DISTANCE, SPEED
from touchcell.tasks.servoing import ServoConfig, one_arm_task
from touchcell.tasks.surface_path import Guide, PathConfig

_TURN_SHARE = 0.8
"""Share of the largest rate of turn that feedforward may use."""


class SurfaceFollowingConfig(ServoConfig):
    """Parameters of surface following. Shear is not controlled: its gains are zero.

    Attributes:
        depth_mm: indentation to hold, normal to the surface.
        speed_mm_s: tangential speed of the sensor.
        direction_deg: direction of travel, from the sensor's x axis towards its y axis.
        distance_mm: distance that the sensor travels.
        path: path to follow in place of a direction and a distance; see ``surface_path``.
        lookahead_mm: how far ahead on the path the sensor heads.
        curvature_window_mm: distance over which the surface's curvature is estimated, with which the sensor turns: the
            longer, the less noise of single frames and the later it turns.
    """

    depth_mm: Annotated[PositiveFloat, DEPTH] = 3.0
    kp_per_s: SixGains = (0.0, 0.0, 8.0, 8.0, 8.0, 0.0)
    ki_per_s2: SixGains = (0.0, 0.0, 16.0, 16.0, 16.0, 0.0)
    speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    direction_deg: float = 0.0
    distance_mm: Annotated[PositiveFloat, DISTANCE] = 100.0
    path: PathConfig | None = None
    lookahead_mm: PositiveFloat = 2.0
    curvature_window_mm: PositiveFloat = 8.0
    return_lift_mm: PositiveFloat | None = 3.0


class TurnFeedforward:
    """Feedforward of turning with a surface that bends, and the speed at which it can be kept up with."""

    def __init__(self, config: SurfaceFollowingConfig) -> None:
        self._curvature = CurvatureEstimator(1e-3 * config.curvature_window_mm)
        self._fastest_rad_s = _TURN_SHARE * np.radians(config.max_turn_deg_s)

    def update(self, step_m: float, T_base_sensor: Array, T_s_f: Array | None) -> None:
        """Take a step along the path and the contact (4, 4) there into account."""
        self._curvature.update(step_m, T_base_sensor, T_s_f)

    def speed_m_s(self, wanted_m_s: float) -> float:
        """Return the speed at which the turn stays within the limits, with a reserve for what touch corrects."""
        bend = float(np.linalg.norm(self._curvature.rad_per_m()[:2]))
        return min(wanted_m_s, float(self._fastest_rad_s) / max(bend, 1e-9))

    def rate_rad_s(self, speed_m_s: float) -> Array:
        """Return the turn (3,) about the axes of the sensor at a speed."""
        rate: Array = speed_m_s * self._curvature.rad_per_m() * (1.0, 1.0, 0.0)
        return rate

    def telemetry(self) -> Mapping[str, float]:
        """Return the curvature about the sensor's axes."""
        about_x, about_y, _ = self._curvature.rad_per_m().tolist()
        return {"curvature_x_per_m": about_x, "curvature_y_per_m": about_y}


class Follow:
    """Behavior of surface following: a tangential feedforward until the distance is covered."""

    def __init__(self, config: SurfaceFollowingConfig) -> None:
        angle = np.radians(config.direction_deg)
        self._direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        self._turn = TurnFeedforward(config)
        self._speed_m_s = 1e-3 * config.speed_mm_s
        self._feedforward = np.concatenate([self._speed_m_s * self._direction, np.zeros(3)])
        self._left_m = 1e-3 * config.distance_mm
        # In a bend it goes no faster than it can turn.
        self._timeout_s = 4.0 * config.distance_mm / config.speed_mm_s + 1.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return self._feedforward

    @property
    def timeout_s(self) -> float:
        """Four times the nominal duration, plus one second."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Add up the distance along the direction of travel; return True once it is covered.

        Noise and corrections in other directions do not count.
        """
        step_m = float(self._direction @ now[:3, :3].T @ (now[:3, 3] - before[:3, 3]))
        self._left_m -= step_m
        self._turn.update(step_m, now, T_s_f)
        speed_m_s = self._turn.speed_m_s(self._speed_m_s)
        self._feedforward = np.concatenate([speed_m_s * self._direction, self._turn.rate_rad_s(speed_m_s)])
        return self._left_m <= 0.0

    def shortfall(self) -> str:
        """Return nothing: it finishes where its distance is covered."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return the curvature of the surface."""
        return self._turn.telemetry()


class FollowPath:
    """Behavior of surface following along a planned path."""

    def __init__(self, config: SurfaceFollowingConfig, path: PathConfig) -> None:
        self._guide = Guide(path.points(), 1e-3 * config.lookahead_mm)
        self._speed_m_s = 1e-3 * config.speed_mm_s
        self._turn = TurnFeedforward(config)
        self._feedforward = np.zeros(6)
        # A path over a surface is longer than in its plane: up to three times where it is steep.
        self._timeout_s = 3.0 * self._guide.length_m / self._speed_m_s + 5.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return self._feedforward

    @property
    def timeout_s(self) -> float:
        """Three times the duration on a plane, plus five seconds."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Head for the next point of the path; return True at its end."""
        direction = self._guide.direction(now)
        self._turn.update(float(direction @ now[:3, :3].T @ (now[:3, 3] - before[:3, 3])), now, T_s_f)
        speed_m_s = self._turn.speed_m_s(self._speed_m_s)
        self._feedforward = np.concatenate([speed_m_s * direction, self._turn.rate_rad_s(speed_m_s)])
        return self._guide.along_m >= self._guide.length_m

    def shortfall(self) -> str:
        """Return nothing: it finishes at the end of its path."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return how much of the path is left, and how far beside it the sensor is."""
        return {
            "path_left_mm": 1e3 * max(self._guide.length_m - self._guide.along_m, 0.0),
            "cross_track_error_mm": 1e3 * self._guide.cross_track_error_m,
            **self._turn.telemetry(),
        }


def _behavior(config: SurfaceFollowingConfig) -> Follow | FollowPath:
    return Follow(config) if config.path is None else FollowPath(config, config.path)


SPEC = one_arm_task(
    "surface_following",
    "slide over an unknown surface at constant depth and normal to it",
    SurfaceFollowingConfig,
    _behavior,
    lambda config: (0.0, 0.0, config.depth_mm, 0.0, 0.0, 0.0),
)
