"""Push by estimation and prediction: the object's centre and lever are estimated as it moves, its path is planned anew
in each cycle, and the tip's feedforward is the motion that takes the object along it."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Final

import numpy as np

from touchcell.control.edge_search import EdgeSearch
from touchcell.control.path import Path, Point
from touchcell.control.push_model import Contact, Motion, PushEstimator, half_between
from touchcell.control.push_steering import Plan, Pose, steer
from touchcell.geometry.types import Array
from touchcell.tasks.free_motion import Goal, heading_of, placed

_STANDING: Final = Motion(0.0, 0.0, 0.0, 0.0, 0.0)
_KNOWN_M: Final = 0.003
"""Standard deviation of the object's centre below which it is known well enough to be acted upon."""
_EXPLORING_M_S: Final = 0.03
"""Speed until the object's centre is known."""
_STARTING_M_S: Final = 0.008
"""Speed until the object moves: a tip that is pressed in fast overshoots, and a follower gives way too early."""
_MOVED_M: Final = 0.4e-3
"""Way of the contact from which the object moves; less may be an error of the depth, which grows meanwhile."""
_LOADING_M: Final = (0.8e-3, 3e-3)
"""Way of the contact over which what its normal is misread under the load of a push shows: the side has not turned yet
but by what the centre of friction is beside the contact."""
_LOADING_M_S: Final = 0.015
"""Speed over that way."""
_MOST_SIDESTEPS: Final = 3
_EXPECTED_M: Final = 0.012
"""Standard deviation of the centre beside the line of the approach."""
_OTHER_SIDE_RAD: Final = math.radians(40.0)
"""Turn of the normal from the approach beyond which another side than expected is touched."""
_TOUCHED_AGAIN_M: Final = 0.5e-3
"""Uncertainty of the centre that a further touch adds."""
_STEERED_M: Final = 0.05
"""Way to the target above which that is judged."""
_SLOPE_M: Final = 0.006
"""Way over which the slope of the planned curvature is smoothed: the end is steered by it."""
_RESERVED: Final = 0.8
"""Share of the tip's limits that steering may use."""
_DELAY_S: Final = 0.005
"""From a decision to the arm's standstill beyond its deceleration."""
_CLEAR_M: Final = 0.008
"""Distance by which a sensor lets go of an object before it steps aside."""
_NEAR_M: Final = 0.004
"""The same beside a side whose edges have been felt."""
_SLOW_M: Final = 0.0015
"""Distance before a side from which it is approached slowly: what touches tell of it is wrong by less ..."""
_UNSURE_M: Final = 0.003
"""... but between edges by which it is only roughly known how it is turned; a fast touch turns a light object."""
_EDGE_SIGMA_M: Final = 1.5e-3
"""Uncertainty of a side's middle by the touch of one edge and a width that nothing has shown to be right ..."""
_EDGES_SIGMA_M: Final = 0.3e-3
"""... and of both edges."""
_WIDTH_M: Final = 0.004
"""Difference of the width that is felt from the one that is expected beyond which both edges are felt again."""
_ECCENTRIC_M: Final = 0.006
"""Standard deviation of the centre of friction from the middle."""
_FOLLOWED_M: Final = 0.010
"""What a follower's force adds to it."""
_REACH_M: Final = 0.002
"""Difference between that distance as it was told and as two arms measure it beyond which it was told wrong: depths are
misread by up to 0.6 mm at each arm."""
_REACH_SIGMA_M: Final = 0.3e-3
"""Uncertainty of the middle along the contact normal."""
_SIDE_SIGMA_RAD: Final = math.radians(2.5)
"""Turn of the normal from one touch of a side to the next beyond which the first was none of that side."""
_MOST_SEARCHES: Final = 2
_ERROR_SHARE: Final = 0.15
"""Share of a cycle's reading in the mean error of the heading."""
_READ_SIGMA_RAD: Final = math.radians(0.4)
"""Standard deviation of a normal that a model reads of a loaded contact ..."""
_FELT_SIGMA_RAD: Final = math.radians(0.25)
"""... of a side's direction by touches that are far apart ..."""
_FELT_SIGMA_M: Final = 0.2e-3
"""... and of where either of two touches is, beyond that."""
_TURN_RAD: Final = math.radians(0.2)
"""Turn of a side over which the place of its middle is compared."""
_FROM_EDGE_M: Final = 0.012
"""Distance of touches of a side from its edges ..."""
_FARTHEST_APART_M: Final = 0.025
"""... and from its middle: farther ones tell no more ..."""
_LEAST_APART_M: Final = 0.006
"""... and nearer ones do not tell how it is turned."""
_BEYOND_CORNER_M: Final = 0.012
"""Distance from a corner at which it shows whether there is another side."""
_SAME_SIDE_RAD: Final = math.radians(8.0)
"""Difference of directions up to which touches may be of one straight side."""
_UNCONFIRMED_M: Final = 0.005
"""Standard deviation of a middle between two edges where nothing shows that there is a side between them."""
_FLAT_RAD: Final = math.radians(3.0)
"""Turn of the normal between them from which a side is not flat."""


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
        side_width_m: width of a flat side, whose edges are felt before the push; None where it is not known.
        followed: True where a follower presses against the far side.
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
    side_width_m: float | None = None
    followed: bool = False


@dataclass(frozen=True, slots=True)
class Progress:
    """Where the object is, by touch and arm pose.

    Attributes:
        center: its middle, with the heading of the contact normal.
        remaining_m: way to the target.
        target_distance_m: distance of its middle from the target.
        sigma_m: standard deviation of that.
        target_lateral_error_m: distance of the target from the contact normal, positive to its left.
        cross_track_error_m: of the centre from the path on which it was to go, positive to its left.
        miss_m: by how much the target will be missed, as far as friction allows to steer.
    """

    center: Pose
    remaining_m: float
    target_distance_m: float
    sigma_m: float
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
        self._estimator = PushEstimator(
            reach_m,
            settings.lever_m2,
            flat=settings.flat,
            eccentricity_m=math.hypot(_ECCENTRIC_M, _FOLLOWED_M if settings.followed else 0.0),
            followed=settings.followed,
        )
        self._path: Path | None = None
        self._along_m = 0.0
        self._start = Pose(0.0, 0.0, 0.0)
        self._start_middle_m = 0.0
        self._sidesteps = 0
        self._searches = 0
        self._has_edge = settings.flat
        # Arms that press beside each other turn what they hold.
        self._must_place = self._has_edge or settings.followed
        self._approach: float | None = None
        self._contact: Contact | None = None
        self._resting_at: Contact | None = None
        self._moves = False
        self._middle: Pose | None = None
        self._resting: tuple[Pose, float] | None = None
        self._rested: tuple[Pose, float] | None = None
        self._steps: Iterator[Goal] = iter(())
        self._felt: Contact | None = None
        self._speed_m_s = 0.0
        self._plan = Plan(0.0, 0.0, math.inf)
        self._side_is_felt = False
        self._side_heading: float | None = None
        self._side_share = _share_of_side(0.0)
        # Of the side's middle to the left, as its edges tell it, per turn of the side.
        self._aside_per_rad = 0.0
        self._heading_error = 0.0
        self._loaded_m = 0.0
        self._loading: list[tuple[float, float]] = []
        self._loading_m = self._moved_m = 0.0
        self.reach_felt_m: float | None = None
        """Half of the object along the contact normal, by the contacts of two arms; None while nothing tells."""
        self.depth_error_m = 0.0
        """What a model reads too much of the contact's depth."""
        self.motion = _STANDING
        self.located: Pose | None = None
        """The object's middle while it rests and will be touched anew, with its heading."""

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

    def velocity_at(self, point: Point) -> tuple[float, float, float]:
        """Return the planned velocity of the object at a point, m/s along x and y, and its rate of turn, rad/s.

        It is zero until the object moves.
        """
        if self._contact is None or not self._moves:
            return 0.0, 0.0, 0.0
        contact, motion = self._contact, self.motion
        cos, sin = math.cos(contact.heading_rad), math.sin(contact.heading_rad)
        dx, dy = point[0] - contact.x_m, point[1] - contact.y_m
        ahead, left, turn = motion.contact_ahead_m_s, motion.contact_left_m_s, motion.turn_rad_s
        return cos * ahead - sin * left - turn * dy, sin * ahead + cos * left + turn * dx, turn

    @property
    def lead_m(self) -> float:
        """From the centre of the tip to the object's centre, where the tip just touches."""
        return self._settings.lead_m

    def touched_beyond(self, far: Contact) -> None:
        """Take a follower's contact with the far side into account, while the object rests between both."""
        if self._moves or self._must_place or self._contact is None or self._resting is not None:
            return
        near, reach_m = self._contact, self._estimator.model.reach_m
        self.reach_felt_m = half_between(near, far, flat=self._settings.flat)
        if self.reach_felt_m is not None and abs(self.reach_felt_m - reach_m) > _REACH_M:
            self._settings = replace(self._settings, lead_m=self._settings.tip_radius_m + self.reach_felt_m)
            self._estimator.change_reach(self.reach_felt_m)
            self._path, self._along_m = None, 0.0

    @property
    def must_place(self) -> bool:
        """True if the present contact will be given up before the object is pushed."""
        return self._must_place

    @property
    def may_sidestep(self) -> bool:
        """True if the contact may be given up for another."""
        return self._settings.recontact_m is not None or self._has_edge or self._settings.followed

    @property
    def wants_sidestep(self) -> bool:
        """True if the object should be let go and touched elsewhere."""
        if self._must_place:
            return True
        limit_m = self._settings.recontact_m
        # A round side's normal points at the middle wherever it is touched.
        if limit_m is None or not self._settings.flat or self._sidesteps >= _MOST_SIDESTEPS:
            return False
        # The first touch tells only how the side is turned.
        if not (self._known or (self._sidesteps == 0 and self._speed_m_s < self._settings.slowest_m_s)):
            return False
        return abs(self._estimator.model.offset_m) > limit_m

    @property
    def _known(self) -> bool:
        """Whether the object's centre is known well enough to be acted upon."""
        return self._estimator.offset_sigma_m < _KNOWN_M

    def begin_sidestep(self, T_base_sensor: Array) -> None:
        """Let go: the object rests where it is until it is touched again."""
        self.pause()
        self._resting_at, self._moves = None, False
        self.located = None
        assert self._contact is not None
        if self._must_place:
            self._must_place = False
            model = self._estimator.model
            self._steps = (
                self._feel_edge(T_base_sensor, self._contact)
                if self._has_edge
                else self._step_to(T_base_sensor, model.middle_m or 0.0, _NEAR_M)
            )
        else:
            self._sidesteps += 1
            self._steps = self._step_to(T_base_sensor, self._estimator.model.offset_m, _CLEAR_M)

    def next_goal(self, T_base_sensor: Array, T_s_f: Array | None) -> Goal | None:
        """Return where the sensor shall go next beside the object; None where it shall touch again.

        Args:
            T_base_sensor: (4, 4) pose of the sensor at the last goal.
            T_s_f: (4, 4) contact made on the way there; None if there was none.
        """
        self._felt = None if T_s_f is None else self.touched(T_base_sensor, T_s_f)
        return next(self._steps, None)

    def _step_to(self, T_base_sensor: Array, left_m: float, clear_m: float) -> Iterator[Goal]:
        """Let go and touch again, farther to the left and straight on."""
        assert self._contact is not None
        assert self._middle is not None
        contact, heading = self._contact, self._contact.heading_rad
        self._resting = self._middle, self._estimator.middle_sigma_m
        self.located = self._middle
        yield Goal(placed(T_base_sensor, _tip_behind(T_base_sensor, heading, clear_m)), passes=True)
        at = Pose(contact.x_m, contact.y_m, heading).ahead(left_m, 0.5 * math.pi)
        yield Goal(placed(T_base_sensor, at.ahead(-self._settings.tip_radius_m - clear_m)))

    def _feel_edge(self, T_base_sensor: Array, side: Contact) -> Iterator[Goal]:
        """Search for the edges of the side, and then be opposite its middle."""
        self._searches += 1
        yield Goal(placed(T_base_sensor, _tip_behind(T_base_sensor, side.heading_rad, _CLEAR_M)), passes=True)
        found, sigma_m = yield from self._middle_of(T_base_sensor, side)
        at = _pose_of(found)
        self._side_is_felt = sigma_m <= _EDGES_SIGMA_M
        middle = at.ahead(self._estimator.model.reach_m)
        self._resting, self.located = (middle, sigma_m), middle
        clear_m = _NEAR_M if self._side_is_felt else _CLEAR_M
        yield Goal(placed(T_base_sensor, at.ahead(-self._settings.tip_radius_m - clear_m)))

    def _middle_of(self, T_base_sensor: Array, side: Contact) -> Generator[Goal, None, tuple[Contact, float]]:
        """Feel both edges of a side, and the side between them; return its middle with its standard deviation."""
        settings = self._settings
        expected_m = self._estimator.model.middle_m or 0.0
        at = _pose_of(side).ahead(expected_m, 0.5 * math.pi)
        found, sigma_m = Contact(at.x, at.y, at.heading), self._estimator.middle_sigma_m
        told = settings.side_width_m
        width_m = told or 2.0 * (settings.lead_m - settings.tip_radius_m)
        for is_told in (told is not None, True):
            one = EdgeSearch(side, expected_m, width_m, settings.tip_radius_m)
            yield from self._feel(T_base_sensor, one, _CLEAR_M)
            if one.at_first is not None and (beyond := (yield from self._side_beyond(T_base_sensor, one))):
                # The first contact was a corner between two sides.
                side, expected_m = beyond, one.left * (0.5 * width_m - _BEYOND_CORNER_M)
                one = EdgeSearch(side, expected_m, width_m, settings.tip_radius_m)
                yield from self._feel(T_base_sensor, one, _CLEAR_M)
            if one.middle is None:
                break
            other = one.opposite()
            yield from self._feel(T_base_sensor, other, _NEAR_M)
            if other.middle is None:
                found, sigma_m = one.middle, _EDGE_SIGMA_M if is_told else sigma_m
                break
            found, felt_m = one.between(other)
            # An edge that was felt wrong at first does not make the width wrong that was told.
            off_m = min(abs(felt_m - width) for width in (width_m, told) if width is not None)
            sigma_m = max(_EDGES_SIGMA_M, 0.5 * off_m)
            if not is_told or sigma_m < 0.5 * _WIDTH_M:
                touches = yield from self._touch_twice(T_base_sensor, found, 0.5 * felt_m, other.left)
                straight = self._straightened(found, touches, (one, other))
                # Where nothing shows that there is a side between the edges, they may be anything else.
                confirmed = straight is not None or 0.5 * felt_m - _FROM_EDGE_M < _LEAST_APART_M
                return straight or found, _EDGES_SIGMA_M if confirmed else max(sigma_m, _UNCONFIRMED_M)
            # Either the width is not what was told, or something else was taken for an edge.
            side, expected_m, width_m = found, 0.0, felt_m
        return found, sigma_m

    def _side_beyond(self, T_base_sensor: Array, edge: EdgeSearch) -> Generator[Goal, None, Contact | None]:
        """Touch farther out than an edge, and return the contact if there is another side with its normal."""
        corner = edge.at_first
        assert corner is not None
        at = _pose_of(corner).ahead(edge.left * _BEYOND_CORNER_M, 0.5 * math.pi)
        clear = at.ahead(-self._settings.tip_radius_m - _CLEAR_M)
        yield Goal(placed(T_base_sensor, clear), passes=True)
        yield Goal(placed(T_base_sensor, clear.ahead(2.0 * _CLEAR_M)), feels=True, slow_m=_CLEAR_M + _SLOW_M)
        felt = self._felt
        yield Goal(placed(T_base_sensor, clear), passes=True)
        if felt is None:
            return None
        ahead_m, left_m = _pose_of(felt).local((corner.x_m, corner.y_m))
        turned = math.remainder(felt.heading_rad - corner.heading_rad, 2.0 * math.pi)
        straight = abs(left_m) > 0.5 * _BEYOND_CORNER_M and abs(ahead_m) < math.tan(_SAME_SIDE_RAD) * abs(left_m)
        return felt if straight and abs(turned) < _SAME_SIDE_RAD else None

    def _touch_twice(
        self, T_base_sensor: Array, middle: Contact, half_m: float, left: float
    ) -> Generator[Goal, None, list[Contact]]:
        """Touch a side on both sides of its middle, the left one first where ``left`` is 1; return what was touched.

        After its edges: each touch turns a light object a little, about a point near where the other one is.
        """
        at = _pose_of(middle)
        apart_m = min(half_m - _FROM_EDGE_M, _FARTHEST_APART_M)
        touches: list[Contact] = []
        if apart_m < _LEAST_APART_M:
            return touches
        # The first one tells the second where the side is.
        for left_m, slow_m in ((left * apart_m, _UNSURE_M), (-left * apart_m, _SLOW_M)):
            clear = at.ahead(-self._settings.tip_radius_m - _NEAR_M).ahead(left_m, 0.5 * math.pi)
            yield Goal(placed(T_base_sensor, clear), passes=True)
            yield Goal(placed(T_base_sensor, clear.ahead(2.0 * _NEAR_M)), feels=True, slow_m=_NEAR_M + slow_m)
            if self._felt is not None:
                touches.append(self._felt)
            yield Goal(placed(T_base_sensor, clear), passes=True)
        return touches

    def _straightened(self, middle: Contact, touches: Sequence[Contact], edges: Sequence[EdgeSearch]) -> Contact | None:
        """Return the middle of a side as the arm's positions at two touches of it, and at its edges, say that it lies.

        Their normals do not count. None where the touches are not on a straight side there.
        """
        if len(touches) < 2:
            return None
        right, left = sorted(touches, key=lambda each: _pose_of(middle).local((each.x_m, each.y_m))[1])
        turned = math.remainder(left.heading_rad - right.heading_rad, 2.0 * math.pi)
        if abs(turned) > _FLAT_RAD:
            return None
        heading = math.atan2(left.y_m - right.y_m, left.x_m - right.x_m) - 0.5 * math.pi
        misread = math.remainder(right.heading_rad + 0.5 * turned - heading, 2.0 * math.pi)
        if max(abs(misread), abs(math.remainder(heading - middle.heading_rad, 2.0 * math.pi))) > _SAME_SIDE_RAD:
            return None
        self._side_share = _share_of_side(math.hypot(left.x_m - right.x_m, left.y_m - right.y_m))
        # What is misread of the tilt moves the point at which a round tip seems to touch.
        x, y = 0.5 * (left.x_m + right.x_m), 0.5 * (left.y_m + right.y_m)
        line = Pose(x, y, heading)
        aside_m, self._aside_per_rad = _middle_on(line, edges), 0.0
        if aside_m is None:
            aside_m = line.local((middle.x_m, middle.y_m))[1] - self._settings.tip_radius_m * misread
        elif (turned_m := _middle_on(Pose(x, y, heading + _TURN_RAD), edges)) is not None:
            self._aside_per_rad = (turned_m - aside_m) / _TURN_RAD
        found = line.ahead(aside_m, 0.5 * math.pi)
        return Contact(found.x, found.y, heading)

    def _feel(self, T_base_sensor: Array, search: EdgeSearch, clear_m: float) -> Iterator[Goal]:
        """Touch until the search has found its edge or failed."""
        while search.middle is None and not search.failed:
            clear = search.tip(clear_m)
            yield Goal(placed(T_base_sensor, clear), passes=True)
            beyond = clear.ahead(clear_m + _CLEAR_M, search.direction_rad - clear.heading)
            yield Goal(placed(T_base_sensor, beyond), feels=True, slow_m=_CLEAR_M + _SLOW_M)
            if self._felt is None:
                search.missed()
            else:
                search.touched(self._felt)
            yield Goal(placed(T_base_sensor, clear), passes=True)

    def touched(self, T_base_sensor: Array, T_s_f: Array) -> Contact:
        """Return the point of the object nearest to the tip's centre, whatever shear there is."""
        depth_m = max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
        normal = T_base_sensor[:3, :3] @ T_s_f[:3, 2]
        at = _tip_behind(T_base_sensor, heading_of(normal), depth_m - self._settings.tip_radius_m)
        return Contact(at.x, at.y, at.heading, depth_m)

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
        center, middle = self._object(T_base_sensor, T_s_f)
        self._lay_path(middle)
        assert self._path is not None
        target = self._path.end
        at = self._path.place((middle.x, middle.y), self._along_m, self._settings.look_ahead_m)
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
        share = min(self._speed_m_s * dt_s / _SLOPE_M, 1.0)
        slope = self._plan.slope + share * (plan.slope - self._plan.slope)
        self._plan = replace(plan, curvature=self._plan.curvature + change, slope=slope)
        self._accelerate(dt_s, remaining_m)
        self.motion = self._estimator.model.motion(self._speed_m_s, self._plan.curvature)
        if (scale := self._within_limits()) < 1.0:
            self._speed_m_s *= scale
            self.motion = self._estimator.model.motion(self._speed_m_s, self._plan.curvature)
        distance_m = math.hypot(target[0] - middle.x, target[1] - middle.y)
        sigma_m = math.hypot(self._estimator.middle_sigma_m, _REACH_SIGMA_M)
        left_m = middle.local(target)[1]
        miss_m = plan.miss_m if self._known and remaining_m > _STEERED_M else 0.0
        remaining_m -= self._stopping_m()
        return Progress(middle, remaining_m, distance_m, sigma_m, left_m, at.cross_track_error_m, miss_m)

    def _lay_path(self, middle: Pose) -> None:
        """Lay the path; a straight one begins where the object's middle was at first, as it is known by now."""
        middle_m = self._estimator.model.middle_m or 0.0
        if self._path is None:
            start = middle.x, middle.y
            self._start, self._start_middle_m = middle, middle_m
            self._path = Path([start, *self._route(start, middle.heading)])
        elif not self._has_waypoints:
            first = self._start.ahead(middle_m - self._start_middle_m, 0.5 * math.pi)
            self._path = Path([(first.x, first.y), self._path.end])

    def _object(self, T_base_sensor: Array, T_s_f: Array) -> tuple[Pose, Pose]:
        """Return the object's centre of friction and its middle by the contact, which the estimator then knows too."""
        settings, estimator = self._settings, self._estimator
        heading = heading_of(T_base_sensor[:3, :3] @ T_s_f[:3, 2])
        heading = self._corrected(heading, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
        if settings.flat:
            # {f} sticks to the object, one tip radius behind its side.
            origin = T_base_sensor[:2, :3] @ T_s_f[:3, 3] + T_base_sensor[:2, 3]
            behind = Pose(float(origin[0]), float(origin[1]), heading)
        else:
            depth_m = max(0.0, -float(T_s_f[:3, 2] @ T_s_f[:3, 3]))
            behind = Pose(float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3]), heading).ahead(-depth_m)
        ahead_m = settings.tip_radius_m + self.depth_error_m
        contact = behind.ahead(ahead_m)
        if self._resting is not None:
            self._touch_again(contact, *self._resting)
            self._rested, self._resting, self.located = self._resting, None, None
        elif self._rested is not None and not self._moves and self._side_heading is not None:
            # Where the contact is beside the middle is known better as the error of its normal is.
            self._place(contact, *self._rested)
        elif self._contact is None and (middle_m := self._expected_offset_m(heading)):
            estimator.move_contact(middle_m, _EXPECTED_M)
        self._contact = Contact(contact.x, contact.y, heading)
        self._resting_at = self._resting_at or self._contact
        self._moved_m, _ = Pose(self._resting_at.x_m, self._resting_at.y_m, heading).local((contact.x, contact.y))
        self._moves = self._moves or self._moved_m > _MOVED_M
        estimator.update(self._contact)
        model = estimator.model
        # What it had turned by while the error of its normal showed was taken for a part of that.
        turned = model.offset_m * self._loading_m / (model.reach_m**2 + model.lever_m2)
        if self._moved_m > _LOADING_M[1] and self._loading:
            # The edges were placed on a side that lay otherwise.
            correction = (1.0 - self._side_share) * (self._heading_error - turned)
            estimator.shift(self._aside_per_rad * correction)
            self._aside_per_rad, model = 0.0, estimator.model
        contact = Pose(behind.x, behind.y, heading + self._side_share * turned).ahead(ahead_m)
        ahead = contact.ahead(model.reach_m)
        self._middle = ahead.ahead(model.middle_m or 0.0, 0.5 * math.pi)
        return ahead.ahead(model.offset_m, 0.5 * math.pi), self._middle

    def _corrected(self, heading: float, depth_m: float) -> float:
        """Return a heading without the error that shows while the object rests: its side lies between its edges.

        Models misread normals otherwise under load than at a touch, so the error counts as it is when the object
        has begun to slide: as large a share of it as touches tell better how the side lies than the model reads it.
        """
        if self._resting is not None and self._side_is_felt:
            self._side_heading, self._heading_error, self._loaded_m = self._resting[0].heading, 0.0, 0.0
            self._loading, self._loading_m, self._moved_m = [], 0.0, 0.0
        if self._side_heading is None:
            return heading
        error = math.remainder(heading - self._side_heading, 2.0 * math.pi)
        begins_m, ends_m = _LOADING_M
        if abs(error) > _SIDE_SIGMA_RAD:
            return heading - self._side_share * self._heading_error
        if not self._moves:
            if depth_m >= self._loaded_m:
                self._heading_error += _ERROR_SHARE * (error - self._heading_error)
                self._loaded_m = depth_m
            return self._side_heading
        if begins_m < self._moved_m < ends_m:
            self._loading.append((self._moved_m, error))
            self._loading_m, self._heading_error = (fmean(each) for each in zip(*self._loading, strict=True))
        return heading - self._side_share * self._heading_error

    def _touch_again(self, contact: Pose, middle: Pose, sigma_m: float) -> None:
        """Know where the middle is beside a new contact, of an object that has rested meanwhile."""
        turned = math.remainder(contact.heading - middle.heading, 2.0 * math.pi)
        if self._has_edge and abs(turned) > _SIDE_SIGMA_RAD and self._searches < _MOST_SEARCHES:
            # What was touched at first was an edge, or the object has turned.
            self._must_place = True
        self._place(contact, middle, sigma_m)

    def _place(self, contact: Pose, middle: Pose, sigma_m: float) -> None:
        """Tell the estimator where a contact is beside a middle that rests."""
        middle_m, sigma_m = contact.local((middle.x, middle.y))[1], math.hypot(sigma_m, _TOUCHED_AGAIN_M)
        if not self._settings.flat:
            middle_m = sigma_m = 0.0
        self._start_middle_m += middle_m - (self._estimator.model.middle_m or 0.0)
        self._estimator.move_contact(middle_m, sigma_m, keep_eccentricity=self._sidesteps > 0)

    def _planned(self, center: Pose, along_m: float) -> Plan:
        assert self._path is not None
        settings, model = self._settings, self._estimator.model
        target, goal = self._path.end, settings.goal_heading_rad
        left_m = self._path.length_m - along_m
        if self._has_waypoints and left_m > settings.look_ahead_m:
            target, goal = self._path.point(along_m + settings.look_ahead_m), None
        return steer(center, model, target, goal, settings.friction, self._plan)

    def _accelerate(self, dt_s: float, remaining_m: float) -> None:
        settings = self._settings
        braking = math.sqrt(2.0 * settings.accel_m_s2 * max(remaining_m - self._stopping_m(), 0.0))
        fastest = settings.speed_m_s if self._known else min(settings.speed_m_s, _EXPLORING_M_S)
        if not self._moves:
            fastest = min(fastest, _STARTING_M_S)
        elif self._side_heading is not None and self._moved_m < _LOADING_M[1]:
            fastest = min(fastest, _LOADING_M_S)
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
            "middle_mm": 1e3 * (model.middle_m or 0.0),
            "middle_sigma_mm": 1e3 * self._estimator.middle_sigma_m,
            "friction_radius_mm": 1e3 * math.sqrt(model.lever_m2),
            "curvature_per_m": self._plan.curvature,
            "push_mm_s": 1e3 * self._speed_m_s,
            "depth_error_mm": 1e3 * self.depth_error_m,
            "heading_read_error_deg": math.degrees(self._heading_error),
        }


def _middle_on(side: Pose, edges: Sequence[EdgeSearch]) -> float | None:
    """Return where the middle between the edges of a straight side is, to the left of a point of it."""
    found_m = [left_m for each in edges if (left_m := each.edge_on(side)) is not None]
    return fmean(found_m) if len(found_m) == len(edges) else None


def _share_of_side(apart_m: float) -> float:
    """Return the share of a side's direction, by touches that are so far apart, in the heading of a push."""
    read, felt = _READ_SIGMA_RAD**2, _FELT_SIGMA_RAD**2
    return read / (read + felt + (_FELT_SIGMA_M / max(apart_m, _LEAST_APART_M)) ** 2)


def _pose_of(contact: Contact) -> Pose:
    return Pose(contact.x_m, contact.y_m, contact.heading_rad)


def _tip_behind(T_base_sensor: Array, heading: float, distance_m: float) -> Pose:
    """Return the tip's centre moved back by a distance against a heading."""
    return Pose(float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3]), heading).ahead(-distance_m)


def twist_in_sensor(ahead_m_s: float, left_m_s: float, turn_rad_s: float, y_is_left: float) -> Array:
    """Return the twist (6,) of a sensor whose z axis points ahead, and whose y axis points left or right."""
    return np.array([0.0, y_is_left * left_m_s, ahead_m_s, -y_is_left * turn_rad_s, 0.0, 0.0])
