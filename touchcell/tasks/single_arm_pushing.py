"""Push an object to a target with one arm: press, steer by moving the contact laterally, stop there (paper 3.3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, ClassVar, Final, Literal, Self

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, model_validator

from touchcell.control.alignment import Aim, AlignmentGains, TargetAlignment
from touchcell.control.path import Point
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import ContactServo, ContactServoConfig, Six, SixGains
from touchcell.tasks.free_motion import Goal
from touchcell.tasks.interface import SPEED, TaskContext, TaskSpec
from touchcell.tasks.planned_motions import Impossible, PlannedMotion, PlannedTime
from touchcell.tasks.planned_places import PlannedPlace
from touchcell.tasks.predictive_push import PredictivePush, PredictivePushSettings, Progress, twist_in_sensor
from touchcell.tasks.push_bounds import PushBounds
from touchcell.tasks.push_path import Obstacle, plan
from touchcell.tasks.push_standing import Standing
from touchcell.tasks.servoing import ARM, SENSOR, ServoConfig, ServoTask, servo_motions

Mm = tuple[float, float]
_SIGMAS = 2.0
"""Standard deviations of the object's place that have to lie within the tolerance."""


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
        steering: ``predictive`` estimates the object's centre as it moves and plans the path to the target anew in
            each cycle (``touchcell.control.push_steering``); ``bearing`` is the paper's controller on the bearing of
            the path, which the keys ``align_*`` set.
        tip_radius_mm: radius of the tip.
        sides: whether the pushed side is flat, or round so that its normal points at the object's centre.
        friction_radius_mm: mean distance of the object's bottom from its centre, a first value for the estimate; 0.8
            of the distance from contact to centre without it: more than of a square (0.77), as a push loads the front.
        contact_friction: slope of the friction cone between skin and object that steering may use.
        recontact_mm: where the object is found to be pushed farther than this beside its centre, the arm lets go of it,
            steps aside and touches it again opposite its centre; none: never.
        side_width_mm: width of the pushed side, at whose edges predictive steering begins to feel for them; twice the
            way from the contact to the object's centre without it. The edges tell where the object's middle is; motion
            only tells its centre of friction.
        push_accel_mm_s2: acceleration at the start of a predictive push, and deceleration at its end.
        arrival_speed_mm_s: its speed where it arrives.
        arrival_tolerance_mm: the task is done only if the object's middle, where touch and arm pose put it, ends this
            close to the target, with twice the standard deviation of that.
        arrival_tolerance_deg: likewise for ``goal_heading_deg``.
        max_cross_track_mm: the push is given up where the object's centre is farther than this from its path, or with
            predictive steering would pass the target at more than this, as far as friction allows to steer.
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
    steering: Literal["predictive", "bearing"] = "predictive"
    tip_radius_mm: PositiveFloat = 20.0
    sides: Literal["flat", "round"] = "flat"
    friction_radius_mm: PositiveFloat | None = None
    contact_friction: PositiveFloat = 0.8
    recontact_mm: PositiveFloat | None = None
    side_width_mm: PositiveFloat | None = None
    push_accel_mm_s2: PositiveFloat = 200.0
    max_speed_mm_s: PositiveFloat = 140.0
    max_turn_deg_s: PositiveFloat = 25.0
    arrival_speed_mm_s: PositiveFloat = 5.0
    arrival_tolerance_mm: PositiveFloat = 5.0
    arrival_tolerance_deg: PositiveFloat = 10.0
    max_cross_track_mm: PositiveFloat = 60.0

    def planned_places(self, arm: str) -> Iterator[PlannedPlace]:
        """Return where the tip of the pushing ``arm`` ends: behind the object's centre, which is at the target then."""
        tip_m = 1e-3 * np.array([*self.target_mm, math.nan])
        slack_m = 1e-3 * (self.object_center_offset_mm + self.arrival_tolerance_mm)
        yield PlannedPlace(("target_mm",), arm, tip_m=tip_m, slack_m=slack_m)

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

    def predictive(self, *, followed: bool = False) -> PredictivePush:
        """Return the predictive steering, in SI units; ``followed`` where a follower presses, too."""
        lead_mm = self.object_center_offset_mm
        radius_mm = self.friction_radius_mm or 0.8 * (lead_mm - self.tip_radius_mm)
        settings = PredictivePushSettings(
            lead_m=1e-3 * lead_mm,
            tip_radius_m=1e-3 * self.tip_radius_mm,
            lever_m2=1e-6 * radius_mm**2,
            flat=self.sides == "flat",
            speed_m_s=1e-3 * self.push_speed_mm_s,
            max_tip_m_s=1e-3 * self.max_speed_mm_s,
            max_turn_rad_s=math.radians(self.max_turn_deg_s),
            slowest_m_s=1e-3 * min(self.arrival_speed_mm_s, self.push_speed_mm_s),
            accel_m_s2=1e-3 * self.push_accel_mm_s2,
            friction=self.contact_friction,
            look_ahead_m=1e-3 * self.look_ahead_mm,
            goal_heading_rad=None if self.goal_heading_deg is None else math.radians(self.goal_heading_deg),
            recontact_m=None if self.recontact_mm is None else 1e-3 * self.recontact_mm,
            side_width_m=None if self.side_width_mm is None else 1e-3 * self.side_width_mm,
            followed=followed,
        )
        return PredictivePush(settings, self.route, has_waypoints=bool(self.path_mm or self.obstacles_mm))

    def route(self, center: Point, heading_rad: float) -> Sequence[Point]:
        """Return the waypoints, m, from the object's centre and heading. Raises NoPathFound."""
        target = 1e-3 * self.target_mm[0], 1e-3 * self.target_mm[1]
        planned = self.goal_heading_deg is not None and self.steering == "bearing"
        if not (planned or self.obstacles_mm):
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
    """Parameters of single-arm pushing.

    Attributes:
        recontact_mm: where the object is found to be pushed farther than this beside its centre, the arm lets go of it,
            steps aside and touches it again opposite its centre; none: never.
    """

    recontact_mm: PositiveFloat | None = 6.0


class Push:
    """Behavior of pushing: along the contact normal, steered to the target, until it is reached."""

    def __init__(self, config: PushConfig, bounds: PushBounds, standing: Standing, *, followed: bool = False) -> None:
        self._speed_m_s = 1e-3 * config.push_speed_mm_s
        self._timeout_s = config.push_timeout_s
        self._alignment = config.alignment()
        self._predictive = config.predictive(followed=followed) if config.steering == "predictive" else None
        self._goal_heading_deg = config.goal_heading_deg
        self._tolerance_m, self._tolerance_deg = 1e-3 * config.arrival_tolerance_mm, config.arrival_tolerance_deg
        self._max_cross_track_m = 1e-3 * config.max_cross_track_mm
        self._lead_m = 1e-3 * config.object_center_offset_mm
        self._bounds = bounds
        self._standing = standing
        self._at_limit = self._fallen = ""
        self._aim: Aim | None = None
        self._miss_m = self._sigma_m = 0.0
        self._left_m_s = 0.0
        self._y_is_left = 1.0
        self.depth_m = 0.0
        """Depth of the contact at the last cycle."""

    @property
    def left_m_s(self) -> float:
        """Lateral speed of the contact commanded by alignment, positive to the left of the contact normal."""
        return self._left_m_s

    @property
    def predictive(self) -> PredictivePush | None:
        """Predictive steering; None with another one."""
        return self._predictive

    @property
    def may_sidestep(self) -> bool:
        """True if the contact may be given up for another."""
        return self._predictive is not None and self._predictive.may_sidestep

    @property
    def wants_sidestep(self) -> bool:
        """True if the object should be let go and touched elsewhere."""
        return self._predictive is not None and self._predictive.wants_sidestep

    @property
    def rests_on(self) -> Sequence[str]:
        """Where the object's centre is behind the side that is pushed, unless two arms have measured it."""
        told_mm, push = 1e3 * self._lead_m, self._predictive
        if push is None:
            return (
                "the object's centre is straight ahead of the contact, and "
                f"object_center_offset_mm is right ({told_mm:g} mm were told): neither was measured",
            )
        if push.reach_felt_m is None:
            return (
                f"object_center_offset_mm is right ({told_mm:g} mm were told): nothing that was touched tells it, and "
                "what it is wrong by the object is off",
            )
        if push.lead_m != self._lead_m:
            return (
                "the object's centre is midway between the sides that both arms touch, "
                f"{1e3 * push.lead_m:.1f} mm ahead, where object_center_offset_mm says {told_mm:g}",
            )
        return ()

    @property
    def only_touches(self) -> bool:
        """True until the object is touched where it will be pushed: that contact will be given up."""
        return self._predictive is not None and self._predictive.must_place

    def begin_approach(self, T_base_sensor: Array) -> None:
        """Take note of the direction of the approach, in which the object is expected."""
        self._standing.begin_approach()
        if self._predictive is not None:
            self._predictive.begin_approach(T_base_sensor)

    def begin_sidestep(self, T_base_sensor: Array) -> None:
        """Let go: the object rests where it is until it is touched again."""
        self._standing.let_go()
        if self._predictive is not None:
            self._predictive.begin_sidestep(T_base_sensor)

    def correct_depth(self, error_m: float) -> None:
        """Take note of how much deeper than it is a model reads the contact."""
        if self._predictive is not None:
            self._predictive.depth_error_m = error_m

    def next_goal(self, T_base_sensor: Array, T_s_f: Array | None) -> Goal | None:
        """Return where the sensor shall go next beside the object; None where it shall touch again."""
        return None if self._predictive is None else self._predictive.next_goal(T_base_sensor, T_s_f)

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        if self._predictive is not None:
            return twist_in_sensor(*self._predictive.tip_motion, self._y_is_left)
        return np.array([0.0, self._y_is_left * self._left_m_s, self._speed_m_s, 0.0, 0.0, 0.0])

    @property
    def timeout_s(self) -> float:
        """The configured timeout."""
        return self._timeout_s

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Update the steering; return True at the end of the path, or where the object is too far from it."""
        self._at_limit = self._bounds.reached(dt_s, before, now, T_s_f)
        if T_s_f is None:
            self._alignment.pause()
            if self._predictive is not None:
                self._predictive.pause()
            self._left_m_s = 0.0
            return bool(self._at_limit)
        self._y_is_left = -float(np.sign(now[2, 0]))
        self.depth_m = max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
        self._fallen = self._fallen or self._standing.changed(dt_s, now, T_s_f)
        if self._predictive is not None:
            progress = self._predictive.update(dt_s, now, T_s_f)
            self._aim, self._miss_m, self._sigma_m = _aim_of(progress), progress.miss_m, progress.sigma_m
        else:
            self._aim = self._alignment.aim(now, T_s_f)
            self._left_m_s = self._alignment.step(self._aim, dt_s)
        ends = bool(self._at_limit) or bool(self._fallen)
        return self._aim.remaining_m <= 0.0 or ends or self._strayed(self._aim)

    def shortfall(self) -> str:
        """Return how far the object ended from its target, or from its path, if that is beyond the tolerances."""
        aim = self._aim
        if aim is None or self._fallen:
            return self._fallen or self._at_limit
        within = aim.target_distance_m + _SIGMAS * self._sigma_m <= self._tolerance_m
        if self._at_limit and aim.remaining_m > 0.0 and not within:
            return f"{self._at_limit}; object {1e3 * aim.target_distance_m:.0f} mm from the target"
        if self._miss_m > self._max_cross_track_m:
            return (
                f"the target cannot be reached: friction turns the object too little, it would pass "
                f"{1e3 * self._miss_m:.0f} mm beside; {1e3 * aim.target_distance_m:.0f} mm from the target"
            )
        if self._strayed(aim):
            return (
                f"object {1e3 * abs(aim.cross_track_error_m):.1f} mm beside its path, limit "
                f"{1e3 * self._max_cross_track_m:g} mm; {1e3 * aim.target_distance_m:.0f} mm from the target"
            )
        if aim.target_distance_m > self._tolerance_m:
            distance_mm = 1e3 * aim.target_distance_m
            return f"object {distance_mm:.1f} mm from the target, tolerance {1e3 * self._tolerance_m:g} mm"
        if not within:
            return (
                f"object {1e3 * aim.target_distance_m:.1f} mm from the target by an estimate whose standard deviation "
                f"is {1e3 * self._sigma_m:.1f} mm: it may be beyond the tolerance, {1e3 * self._tolerance_m:g} mm"
            )
        error_deg = self._heading_error_deg(aim)
        if error_deg is not None and abs(error_deg) > self._tolerance_deg:
            return f"heading {error_deg:+.1f} deg off at the target, tolerance {self._tolerance_deg:g} deg"
        return ""

    def _strayed(self, aim: Aim) -> bool:
        if self._predictive is not None:
            return self._miss_m > self._max_cross_track_m and not self._predictive.wants_sidestep
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
            **({} if self._predictive is None else self._predictive.telemetry()),
        }


def _aim_of(progress: Progress) -> Aim:
    return Aim(
        0.0,
        progress.remaining_m,
        progress.cross_track_error_m,
        progress.target_lateral_error_m,
        progress.target_distance_m,
        progress.center.heading,
    )


_BEHIND: Final = 0.5
"""Cosine from which on a target is so far behind that no push turns round to it."""


def _motions(config: SingleArmPushingConfig, T_base_tcp: Array | None, T_tcp_sensor: Array) -> Iterator[PlannedMotion]:
    """Return how long the push takes at least, from where an approach may have made contact, besides the rest."""
    yield from servo_motions(config)
    if T_base_tcp is None:
        return
    T_base_sensor = T_base_tcp @ T_tcp_sensor
    tip_mm = 1e3 * T_base_sensor[:2, 3]
    ahead_mm = float(T_base_sensor[:2, 2] @ (np.array(config.target_mm) - tip_mm))
    planned = config.path_mm or config.obstacles_mm or config.goal_heading_deg is not None
    if not planned and ahead_mm < -_BEHIND * math.dist(tip_mm, config.target_mm):
        why = "is behind the sensor, which can only push away from itself"
        yield Impossible(("target_mm",), why, "start on the other side of the object")
    way_mm = math.dist(tip_mm, config.target_mm) - config.approach_distance_mm
    way_mm -= config.object_center_offset_mm + config.arrival_tolerance_mm
    takes_s = max(way_mm, 0.0) / config.push_speed_mm_s
    yield PlannedTime(("push_timeout_s",), takes_s, config.push_timeout_s, "to push so far")


def build(config: SingleArmPushingConfig, context: TaskContext) -> ServoTask:
    """Build the task for a cell that has ``arm`` with a sensor."""
    push = Push(config, PushBounds(context, ARM, SENSOR), Standing(SENSOR))
    servo = ContactServo(ARM, SENSOR, config, config.reference_mm_deg, push, context)
    return ServoTask("single_arm_pushing", config, context, servo)


SPEC = TaskSpec(
    name="single_arm_pushing",
    summary="push an object over a table to a target, steering it by touch",
    config=SingleArmPushingConfig,
    arms={ARM: SERVO_ARM},
    sensors=frozenset({SENSOR}),
    build=build,
    starts_free=True,
    glides=True,
    places=lambda config, start, mount: config.planned_places(ARM),
    motions=_motions,
)
