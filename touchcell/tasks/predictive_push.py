"""Push by estimation and prediction: the object's centre and lever are estimated as it moves, its path is planned anew
in each cycle, and the tip's feedforward is the motion that takes the object along it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from touchcell.control.path import Path, Point
from touchcell.control.push_model import Contact, Motion, PushEstimator
from touchcell.control.push_steering import Plan, Pose, steer
from touchcell.geometry.types import Array

_STANDING: Final = Motion(0.0, 0.0, 0.0, 0.0, 0.0)
_KNOWN_M: Final = 0.003
"""Standard deviation of the object's centre below which it is known well enough to be acted upon."""
_EXPLORING_M_S: Final = 0.03
"""Speed until the object's centre is known."""
_MOST_SIDESTEPS: Final = 3
_EXPECTED_M: Final = 0.012
"""Standard deviation of the centre beside the line of the approach."""
_OTHER_SIDE_RAD: Final = math.radians(40.0)
"""Turn of the normal from the approach beyond which another side than expected is touched."""
_TOUCHED_AGAIN_M: Final = 0.5e-3
"""Uncertainty of the centre that a further touch adds."""
_STEERED_M: Final = 0.05
"""Way to the target above which that is judged."""
_RESERVED: Final = 0.8
"""Share of the tip's limits that steering may use."""
_DELAY_S: Final = 0.02
"""From a decision to the arm's standstill beyond its deceleration."""


@dataclass(frozen=True, slots=True)
class PredictivePushSettings:
    """Settings of a predictive push, SI.

    Attributes:
        lead_m: from the centre of the tip to the object's centre, where the tip just touches.
        tip_radius_m: radius of the tip.
        lever_m2: square of the object's friction radius, a first value.
        flat: False where the pushed side is round, so that its normal points at the centre.
        speed_m_s: of the push.
        max_tip_m_s: largest speed of the tip.
        max_turn_rad_s: largest rate of turn of the tip.
        slowest_m_s: of its end.
        accel_m_s2: with which it gathers and loses speed.
        friction: slope of the friction cone that may be used.
        look_ahead_m: along paths with waypoints.
        goal_heading_rad: of the contact normal at the target; None where it is free.
        recontact_m: the object is touched anew nearer to its centre where it is pushed farther beside it; None never.
    """

    lead_m: float
    tip_radius_m: float
    lever_m2: float
    flat: bool
    speed_m_s: float
    max_tip_m_s: float
    max_turn_rad_s: float
    slowest_m_s: float
    accel_m_s2: float
    friction: float
    look_ahead_m: float
    goal_heading_rad: float | None
    recontact_m: float | None


@dataclass(frozen=True, slots=True)
class Progress:
    """Where the object is, by touch and arm pose.

    Attributes:
        center: its centre, with the heading of the contact normal.
        remaining_m: way to the target.
        target_distance_m: distance of its centre from the target.
        target_lateral_error_m: distance of the target from the contact normal, positive to its left.
        cross_track_error_m: of the centre from the path on which it was to go, positive to its left.
        miss_m: by how much the target will be missed, as far as friction allows to steer.
    """

    center: Pose
    remaining_m: float
    target_distance_m: float
    target_lateral_error_m: float
    cross_track_error_m: float
    miss_m: float


class PredictivePush:
    """Estimator and steering of one push.

    Args:
        settings: see there.
        route: returns waypoints from the object's centre and heading, without the start; the last one is the target.
        has_waypoints: True where the route has waypoints that count, and is not only a straight line to the target.
    """

    def __init__(
        self,
        settings: PredictivePushSettings,
        route: Callable[[Point, float], Sequence[Point]],
        *,
        has_waypoints: bool,
    ) -> None:
        self._settings = settings
        self._route = route
        self._has_waypoints = has_waypoints
        reach_m = settings.lead_m - settings.tip_radius_m
        self._estimator = PushEstimator(reach_m, settings.lever_m2, flat=settings.flat)
        self._path: Path | None = None
        self._along_m = 0.0
        self._start = Pose(0.0, 0.0, 0.0)
        self._start_offset_m = 0.0
        self._known_offset_m = 0.0
        self._sidesteps = 0
        self._approach: float | None = None
        self._latest: Pose | None = None
        self._resting: Pose | None = None
        self._speed_m_s = 0.0
        self._plan = Plan(0.0, 0.0, math.inf)
        self.motion = _STANDING

    @property
    def estimator(self) -> PushEstimator:
        """What is known about the object."""
        return self._estimator

    @property
    def tip_motion(self) -> tuple[float, float, float]:
        """Velocity of the tip's centre along and to the left of the contact normal, m/s, and its turn to the left."""
        motion = self.motion
        return (
            motion.contact_ahead_m_s,
            motion.contact_left_m_s - self._settings.tip_radius_m * motion.turn_rad_s,
            motion.turn_rad_s,
        )

    def begin_approach(self, T_base_sensor: Array) -> None:
        """Take note of the direction of the first approach: along it the object's centre is expected."""
        if self._approach is None:
            self._approach = math.atan2(float(T_base_sensor[1, 2]), float(T_base_sensor[0, 2]))

    def _expected_offset_m(self, heading: float) -> float:
        """Return where the centre is, to the left of a first contact, if it lies on the line of the approach."""
        if self._approach is None or not self._settings.flat:
            return 0.0
        turned = math.remainder(heading - self._approach, 2.0 * math.pi)
        if abs(turned) > _OTHER_SIDE_RAD:
            return 0.0
        reach_m = self._settings.lead_m - self._settings.tip_radius_m
        return min(max(-self._settings.lead_m * math.tan(turned), -reach_m), reach_m)

    @property
    def may_sidestep(self) -> bool:
        """True if the contact may be given up for another."""
        return self._settings.recontact_m is not None

    @property
    def sidestep_m(self) -> float | None:
        """By how much the contact should be moved to the left, to be opposite the object's centre; None if it is."""
        limit_m = self._settings.recontact_m
        if limit_m is None or self._sidesteps >= _MOST_SIDESTEPS:
            return None
        offset_m = self._estimator.model.offset_m
        # The first touch tells only how the side is turned.
        if not (self._known or (self._sidesteps == 0 and self._speed_m_s < self._settings.slowest_m_s)):
            return None
        return offset_m if abs(offset_m) > limit_m else None

    @property
    def _known(self) -> bool:
        """Whether the object's centre is known well enough to be acted upon."""
        return self._estimator.offset_sigma_m < _KNOWN_M

    def move_contact(self) -> None:
        """Keep where the object is: it will be touched elsewhere next."""
        self._sidesteps += 1
        self._resting = self._latest
        self.pause()

    def pause(self) -> None:
        """Stand still: the contact is not known."""
        self.motion = _STANDING
        self._speed_m_s = 0.0

    def update(self, dt_s: float, T_base_sensor: Array, T_s_f: Array) -> Progress:
        """Take a contact into account and plan.

        Args:
            dt_s: time since the last call.
            T_base_sensor: (4, 4) pose of the sensor, its x axis upright.
            T_s_f: (4, 4) contact.

        Raises:
            ControlError: the path is degenerate.
        """
        center = self._center(T_base_sensor, T_s_f)
        self._lay_path(center)
        assert self._path is not None
        target = self._path.end
        at = self._path.place((center.x, center.y), self._along_m, self._settings.look_ahead_m)
        self._along_m = max(self._along_m, at.along_m)
        plan = self._planned(center, at.along_m)
        if not self._known:
            # Straight ahead, whatever turns the object tells where its centre is.
            plan = replace(plan, curvature=0.0)
        remaining_m = plan.remaining_m
        if self._has_waypoints:
            remaining_m = max(remaining_m, self._path.length_m - at.along_m - 2.0 * self._settings.look_ahead_m)
        # The tip's centre moves to the left by about this much per curvature and speed, and is accelerated likewise.
        model = self._estimator.model
        arm_m = self._settings.lead_m + model.lead_m
        speed_m_s = max(self._speed_m_s, self._settings.slowest_m_s)
        largest = self._settings.accel_m_s2 * dt_s / (arm_m * speed_m_s)
        change = min(max(plan.curvature - self._plan.curvature, -largest), largest)
        self._plan = replace(plan, curvature=self._plan.curvature + change)
        self._accelerate(dt_s, remaining_m)
        self.motion = self._estimator.model.motion(self._speed_m_s, self._plan.curvature)
        if (scale := self._within_limits()) < 1.0:
            self._speed_m_s *= scale
            self.motion = self._estimator.model.motion(self._speed_m_s, self._plan.curvature)
        distance_m = math.hypot(target[0] - center.x, target[1] - center.y)
        left_m = center.local(target)[1]
        miss_m = plan.miss_m if self._known and remaining_m > _STEERED_M else 0.0
        return Progress(center, remaining_m - self._stopping_m(), distance_m, left_m, at.cross_track_error_m, miss_m)

    def _lay_path(self, center: Pose) -> None:
        """Lay the path; a straight one begins where the object's centre was at first, as it is known by now."""
        offset_m = self._estimator.model.offset_m
        if self._path is None:
            start = center.x, center.y
            self._start, self._start_offset_m = center, offset_m
            self._path = Path([start, *self._route(start, center.heading)])
        elif not self._has_waypoints:
            first = self._start.ahead(offset_m - self._start_offset_m, 0.5 * math.pi)
            self._path = Path([(first.x, first.y), self._path.end])

    def _center(self, T_base_sensor: Array, T_s_f: Array) -> Pose:
        """Return the object's centre by the contact, which the estimator then knows too."""
        settings = self._settings
        R = T_base_sensor[:3, :3]
        normal = R[:2] @ T_s_f[:3, 2]
        heading = math.atan2(float(normal[1]), float(normal[0]))
        if settings.flat:
            # {f} sticks to the object, one tip radius behind its side.
            origin = T_base_sensor[:2, :3] @ T_s_f[:3, 3] + T_base_sensor[:2, 3]
            behind = Pose(float(origin[0]), float(origin[1]), heading)
        else:
            depth_m = max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
            behind = Pose(float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3]), heading).ahead(-depth_m)
        contact = behind.ahead(settings.tip_radius_m)
        if (resting := self._resting) is not None:
            offset_m = contact.local((resting.x, resting.y))[1]
            self._estimator.move_contact(offset_m, self._estimator.offset_sigma_m + _TOUCHED_AGAIN_M)
            # The path goes on from the same start.
            self._start_offset_m += offset_m - self._known_offset_m
            self._resting = None
        elif self._latest is None and (offset_m := self._expected_offset_m(heading)):
            self._estimator.move_contact(offset_m, _EXPECTED_M)
        self._estimator.update(Contact(contact.x, contact.y, heading))
        model = self._estimator.model
        self._known_offset_m = model.offset_m
        self._latest = contact.ahead(model.reach_m).ahead(model.offset_m, 0.5 * math.pi)
        return self._latest

    def _planned(self, center: Pose, along_m: float) -> Plan:
        assert self._path is not None
        settings, model = self._settings, self._estimator.model
        target, goal = self._path.end, settings.goal_heading_rad
        left_m = self._path.length_m - along_m
        if self._has_waypoints and left_m > settings.look_ahead_m:
            target, goal = self._path.point(along_m + settings.look_ahead_m), None
        return steer(center, model, target, goal, settings.friction, self._plan.curvature)

    def _accelerate(self, dt_s: float, remaining_m: float) -> None:
        settings = self._settings
        braking = math.sqrt(2.0 * settings.accel_m_s2 * max(remaining_m - self._stopping_m(), 0.0))
        fastest = settings.speed_m_s if self._known else min(settings.speed_m_s, _EXPLORING_M_S)
        wanted = min(fastest, max(braking, settings.slowest_m_s))
        self._speed_m_s = min(wanted, self._speed_m_s + settings.accel_m_s2 * dt_s)

    def _within_limits(self) -> float:
        """Return the share of the present speed at which the tip stays within its limits, with a reserve for touch."""
        ahead, left, turn = self.tip_motion
        tip = _RESERVED * self._settings.max_tip_m_s / max(math.hypot(ahead, left), 1e-9)
        return min(tip, _RESERVED * self._settings.max_turn_rad_s / max(abs(turn), 1e-9))

    def _stopping_m(self) -> float:
        return _DELAY_S * self._settings.slowest_m_s

    def telemetry(self) -> Mapping[str, float]:
        """Return what is estimated and planned."""
        model = self._estimator.model
        return {
            "center_offset_mm": 1e3 * model.offset_m,
            "center_offset_sigma_mm": 1e3 * self._estimator.offset_sigma_m,
            "friction_radius_mm": 1e3 * math.sqrt(model.lever_m2),
            "curvature_per_m": self._plan.curvature,
            "push_mm_s": 1e3 * self._speed_m_s,
        }


def twist_in_sensor(ahead_m_s: float, left_m_s: float, turn_rad_s: float, y_is_left: float) -> Array:
    """Return the twist (6,) of a sensor whose z axis points ahead, and whose y axis points left or right."""
    return np.array([0.0, y_is_left * left_m_s, ahead_m_s, -y_is_left * turn_rad_s, 0.0, 0.0])
