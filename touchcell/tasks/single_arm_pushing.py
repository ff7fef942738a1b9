"""Push an object to a target with one arm: press, steer by moving the contact laterally, stop there (paper 3.3.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, model_validator

from touchcell.control.alignment import Aim, AlignmentGains, TargetAlignment
from touchcell.control.path import Point
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import ContactServoConfig, Six, SixGains
from touchcell.tasks.interface import SPEED
from touchcell.tasks.push_path import Obstacle, plan
from touchcell.tasks.servoing import ServoConfig, one_arm_task

Mm = tuple[float, float]


class PushConfig(ContactServoConfig):
    """Parameters of the pushing arm.

    The servo keeps the sensor normal to the object; the indentation results from the object's friction, and the contact
    point is left to target alignment.

    Attributes:
        reference_mm_deg: contact to hold; only the components with gains count.
        target_mm: x and y of the target in the arm's base frame, whose z axis is upright.
        path_mm: waypoints before the target, where no path is planned.
        goal_heading_deg: heading of the contact normal at the target, from the base's x axis; with it, or with
            obstacles,
            the path is planned (``touchcell.tasks.push_path``).
        obstacles_mm: x, y and radius of discs on the table.
        clearance_mm: smallest distance of the object's centre from obstacles.
        turning_radius_mm: of planned paths; no less than a stable push can turn.
        push_speed_mm_s: speed along the sensor's axis.
        object_center_offset_mm: the object's centre, ahead of the centre of the tip: the tip's radius and half of the
            object. That point is brought to the target, and the object turns about it.
        look_ahead_mm: look-ahead distance on the path.
        align_kp_mm_s_per_deg: lateral speed per degree of the bearing of the look-ahead point.
        align_ki_deg_per_mm_s: crab angle rate per cross-track error.
        align_kd_mm_per_deg: derivative gain on the bearing.
        align_max_mm_s: largest lateral speed.
        push_timeout_s: longest duration of the push.
        arrival_tolerance_mm: the task is done only if the object's centre, where touch and arm pose put it, ends this
            close to the target.
        arrival_tolerance_deg: likewise for ``goal_heading_deg``.
        max_cross_track_mm: the push is given up where the object's centre is farther than this from its path.
    """

    renamed_keys: ClassVar[Mapping[str, str]] = {"middle_mm": "object_center_offset_mm"}

    reference_mm_deg: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    kp_per_s: SixGains = (0.0, 0.0, 0.0, 8.0, 0.0, 0.0)
    ki_per_s2: SixGains = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    target_mm: Mm
    path_mm: tuple[Mm, ...] = ()
    goal_heading_deg: float | None = None
    obstacles_mm: tuple[tuple[float, float, PositiveFloat], ...] = ()
    clearance_mm: PositiveFloat = 60.0
    turning_radius_mm: PositiveFloat = 120.0
    push_speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    object_center_offset_mm: PositiveFloat = 60.0
    look_ahead_mm: PositiveFloat = 60.0
    align_kp_mm_s_per_deg: PositiveFloat = 5.0
    align_ki_deg_per_mm_s: NonNegativeFloat = 0.2
    align_kd_mm_per_deg: NonNegativeFloat = 0.0
    align_max_mm_s: PositiveFloat = 10.0
    push_timeout_s: PositiveFloat = 120.0
    arrival_tolerance_mm: PositiveFloat = 5.0
    arrival_tolerance_deg: PositiveFloat = 10.0
    max_cross_track_mm: PositiveFloat = 60.0

    def alignment(self) -> TargetAlignment:
        """Return the steering controller, in SI units."""
        per_rad = 1e-3 * np.degrees(1.0)
        gains = AlignmentGains(
            kp=self.align_kp_mm_s_per_deg * per_rad,
            ki=1e3 * np.radians(self.align_ki_deg_per_mm_s),
            kd=self.align_kd_mm_per_deg * per_rad,
            limit_m_s=1e-3 * self.align_max_mm_s,
            look_ahead_m=1e-3 * self.look_ahead_mm,
            lead_m=1e-3 * self.object_center_offset_mm,
        )
        return TargetAlignment(self.route, gains)

    def route(self, center: Point, heading_rad: float) -> Sequence[Point]:
        """Return the waypoints, m, from the object's centre and heading. Raises NoPathFound."""
        target = 1e-3 * self.target_mm[0], 1e-3 * self.target_mm[1]
        if self.goal_heading_deg is None and not self.obstacles_mm:
            return [*((1e-3 * x, 1e-3 * y) for x, y in self.path_mm), target]
        goal_rad = math.atan2(target[1] - center[1], target[0] - center[0])
        if self.goal_heading_deg is not None:
            goal_rad = math.radians(self.goal_heading_deg)
        obstacles = [Obstacle(1e-3 * x, 1e-3 * y, 1e-3 * (r + self.clearance_mm)) for x, y, r in self.obstacles_mm]
        return plan((*center, heading_rad), (*target, goal_rad), 1e-3 * self.turning_radius_mm, obstacles)

    @model_validator(mode="after")
    def _waypoints_or_planning(self) -> Self:
        if self.path_mm and (self.goal_heading_deg is not None or self.obstacles_mm):
            raise ValueError("path_mm already defines the path: leave out goal_heading_deg and obstacles_mm")
        return self


class SingleArmPushingConfig(PushConfig, ServoConfig):
    """Parameters of single-arm pushing."""


class Push:
    """Behavior of pushing: forward along the contact normal, lateral target alignment, until the target is reached."""

    def __init__(self, config: PushConfig) -> None:
        self._speed_m_s = 1e-3 * config.push_speed_mm_s
        self._timeout_s = config.push_timeout_s
        self._alignment = config.alignment()
        self._goal_heading_deg = config.goal_heading_deg
        self._tolerance_m, self._tolerance_deg = 1e-3 * config.arrival_tolerance_mm, config.arrival_tolerance_deg
        self._max_cross_track_m = 1e-3 * config.max_cross_track_mm
        self._aim: Aim | None = None
        self._left_m_s = 0.0
        self._y_is_left = 1.0

    @property
    def left_m_s(self) -> float:
        """Lateral speed of the contact commanded by alignment, positive to the left of the contact normal."""
        return self._left_m_s

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        return np.array([0.0, self._y_is_left * self._left_m_s, self._speed_m_s, 0.0, 0.0, 0.0])

    @property
    def timeout_s(self) -> float:
        """The configured timeout."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Update target alignment; return True at the end of the path, or where the object is too far from it."""
        if T_s_f is None:
            self._alignment.pause()
            self._left_m_s = 0.0
            return False
        self._y_is_left = -float(np.sign(now[2, 0]))
        self._aim = self._alignment.aim(now, T_s_f)
        self._left_m_s = self._alignment.step(self._aim, dt_s)
        return self._aim.remaining_m <= 0.0 or self._strayed(self._aim)

    def shortfall(self) -> str:
        """Return how far the object ended from its target, or from its path, if that is beyond the tolerances."""
        aim = self._aim
        if aim is None:
            return ""
        if self._strayed(aim):
            return (
                f"object {1e3 * abs(aim.cross_track_error_m):.1f} mm beside its path, limit "
                f"{1e3 * self._max_cross_track_m:g} mm; {1e3 * aim.target_distance_m:.0f} mm from the target"
            )
        if aim.target_distance_m > self._tolerance_m:
            distance_mm = 1e3 * aim.target_distance_m
            return f"object {distance_mm:.1f} mm from the target, tolerance {1e3 * self._tolerance_m:g} mm"
        error_deg = self._heading_error_deg(aim)
        if error_deg is not None and abs(error_deg) > self._tolerance_deg:
            return f"heading {error_deg:+.1f} deg off at the target, tolerance {self._tolerance_deg:g} deg"
        return ""

    def _strayed(self, aim: Aim) -> bool:
        return abs(aim.cross_track_error_m) > self._max_cross_track_m

    def _heading_error_deg(self, aim: Aim) -> float | None:
        goal_deg = self._goal_heading_deg
        return None if goal_deg is None else math.remainder(math.degrees(aim.heading_rad) - goal_deg, 360.0)

    def telemetry(self) -> Mapping[str, float]:
        """Return remaining distance, lateral errors, heading, and the alignment command."""
        if self._aim is None:
            return {}
        heading_deg = float(np.degrees(self._aim.heading_rad))
        error_deg = self._heading_error_deg(self._aim)
        off = {} if error_deg is None else {"heading_error_deg": error_deg}
        return {
            "remaining_mm": 1e3 * self._aim.remaining_m,
            "target_distance_mm": 1e3 * self._aim.target_distance_m,
            "target_lateral_error_mm": 1e3 * self._aim.target_lateral_error_m,
            "cross_track_error_mm": 1e3 * self._aim.cross_track_error_m,
            "bearing_deg": float(np.degrees(self._aim.theta_rad)),
            "heading_deg": heading_deg,
            "align_mm_s": 1e3 * self._left_m_s,
            **off,
        }


SPEC = one_arm_task(
    "single_arm_pushing",
    "push an object over a table to a target, steering it by touch",
    SingleArmPushingConfig,
    Push,
    lambda config: config.reference_mm_deg,
)
