"""Push an object to a target with two arms (paper 3.3.4).

The leader pushes and steers; the follower holds the far side and moves along, which keeps tall objects from toppling.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Final

import numpy as np
from pydantic import PositiveFloat

from touchcell.control.push_steering import Pose
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import ContactServo, ContactServoConfig, Six, SixGains
from touchcell.tasks.free_motion import Goal, heading_of, placed
from touchcell.tasks.interface import CONTACT_DEPTH, TaskContext, TaskSpec
from touchcell.tasks.predictive_push import PredictivePush, twist_in_sensor
from touchcell.tasks.push_bounds import PushBounds
from touchcell.tasks.push_standing import Standing
from touchcell.tasks.servoing import ServoConfig, ServoTask, servo_motions
from touchcell.tasks.single_arm_pushing import Push, PushConfig

LEADER: Final = "leader"
FOLLOWER: Final = "follower"
LEADER_SENSOR: Final = "leader_sensor"
FOLLOWER_SENSOR: Final = "follower_sensor"
_CLEAR_M: Final = 0.015
"""Distance by which the follower lets go of an object: a turned one reaches farther while it steps aside."""
_NEAR_M: Final = 0.006
"""The same beyond a far side that has been touched where it was expected ..."""
_AGREES_M: Final = 0.003
"""... which is within this."""
_EASED_PER_M: Final = 0.6
"""Depth by which the follower presses less, per depth of the leader beyond that from which it eases."""


class FollowerConfig(ContactServoConfig):
    """Parameters of the follower: object tracking at a depth that presses the object onto the leader.

    Attributes:
        reference_mm_deg: contact to hold; only the components with gains count.
        active: if True, its feedforward also moves it with the object, as fast as the leader drives and turns it, so
            that
            touch only corrects the rest: both arms are active. If False, it only complies, as in the paper.
        ease_from_mm: depth of the leader from which an active follower presses less: what it presses with the leader
            has to push, too.
        ease_to_mm: depth to which it may come down.
        turn_deg_per_mm: rotation of the object per lateral motion of the leader's contact; of an 80 mm square it is
            0.9, a / (a^2 + c^2) with a from its centre to the contact and c its friction radius.
    """

    active: bool = True
    turn_deg_per_mm: PositiveFloat = 0.9
    ease_from_mm: PositiveFloat = 5.0
    ease_to_mm: PositiveFloat = 0.8
    reference_mm_deg: Annotated[Six, CONTACT_DEPTH] = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    kp_per_s: SixGains = (0.0, 10.0, 10.0, 10.0, 0.0, 0.0)
    ki_per_s2: SixGains = (0.0, 25.0, 25.0, 25.0, 0.0, 0.0)
    integral_zone_mm: PositiveFloat = 5.0
    integral_zone_deg: PositiveFloat = 10.0
    max_speed_mm_s: PositiveFloat = 140.0
    max_turn_deg_s: PositiveFloat = 25.0
    settle_tolerance_mm: PositiveFloat = 0.5


class DualArmPushingConfig(PushConfig, ServoConfig):
    """Parameters of dual-arm pushing; those of pushing apply to the leader, in the leader's base frame.

    Attributes:
        align_max_mm_s: largest lateral speed: more than for a single arm, since the follower adds drag.
        follower: parameters of the follower's servo.
    """

    align_max_mm_s: PositiveFloat = 15.0
    follower: FollowerConfig = FollowerConfig()


class Follow:
    """Behavior of the follower: moves with the object as the leader drives it. The leader decides when it is done.

    Args:
        config: parameters.
        push: the leader's behavior.
        bounds: of the follower.
        standing: watch over the object by the follower.
        T_leader_follower: pose (4, 4) of the follower's base in the leader's.
    """

    def __init__(
        self,
        config: DualArmPushingConfig,
        push: Push,
        bounds: PushBounds,
        standing: Standing,
        T_leader_follower: Array,
    ) -> None:
        self._push = push
        self._bounds = bounds
        self._standing = standing
        self._at_limit = ""
        self._active = config.follower.active
        self._T_leader_follower = T_leader_follower
        self._speed_m_s = 1e-3 * config.push_speed_mm_s
        self._told_middle_m = 1e-3 * config.object_center_offset_mm
        self._tip_radius_m = 1e-3 * config.tip_radius_mm
        self._ease_from_m = 1e-3 * config.follower.ease_from_mm
        self._most_ease_m = max(0.0, 1e-3 * (config.follower.reference_mm_deg[2] - config.follower.ease_to_mm))
        self._turn_per_m = 1e3 * np.radians(config.follower.turn_deg_per_mm)
        self._T_base_sensor: Array | None = None
        self._far: Pose | None = None
        self._y_is_left = 1.0
        self._steps: Iterator[Goal] = iter(())

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame: that of the object where the tip is.

        With predictive steering it is known; otherwise it is that of a point of the object as far beyond its centre as
        the leader is before it.
        """
        if not self._active:
            return np.zeros(6)
        if self._push.predictive is not None:
            return self._object_twist(self._push.predictive)
        turn_rad_s = self._turn_per_m * self._push.left_m_s
        aside_m_s = self._y_is_left * self._middle_m * turn_rad_s
        return np.array([0.0, aside_m_s, -self._speed_m_s, self._y_is_left * turn_rad_s, 0.0, 0.0])

    def _object_twist(self, push: PredictivePush) -> Array:
        if self._T_base_sensor is None:
            return np.zeros(6)
        T = self._T_leader_follower @ self._T_base_sensor
        vx, vy, turn = push.velocity_at((float(T[0, 3]), float(T[1, 3])))
        heading = heading_of(T[:3, 2])
        cos, sin = math.cos(heading), math.sin(heading)
        return twist_in_sensor(cos * vx + sin * vy, cos * vy - sin * vx, turn, self._y_is_left)

    @property
    def _middle_m(self) -> float:
        push = self._push.predictive
        return self._told_middle_m if push is None else push.lead_m

    @property
    def ease_m(self) -> float:
        """Depth by which it presses less, because the leader is near the depth that its tip bears."""
        if not self._active:
            return 0.0
        return min(max(_EASED_PER_M * (self._push.depth_m - self._ease_from_m), 0.0), self._most_ease_m)

    @property
    def timeout_s(self) -> float:
        """Infinite: the leader's timeout applies."""
        return float("inf")

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Return True only at a limit: the leader decides when the object has arrived."""
        self._y_is_left = -float(np.sign(now[2, 0]))
        self._T_base_sensor = now
        push = self._push.predictive
        if push is not None and T_s_f is not None:
            far = push.touched(self._T_leader_follower @ now, T_s_f)
            self._far = Pose(far.x_m, far.y_m, far.heading_rad)
            push.touched_beyond(far)
        fallen = "" if T_s_f is None else self._standing.changed(dt_s, now, T_s_f)
        self._at_limit = fallen or self._bounds.reached(dt_s, before, now, T_s_f)
        return bool(self._at_limit)

    @property
    def may_sidestep(self) -> bool:
        """True if the leader may let go of the object, too."""
        return self._push.may_sidestep

    @property
    def wants_sidestep(self) -> bool:
        """False: the leader decides."""
        return False

    @property
    def only_touches(self) -> bool:
        """True until the arms are opposite each other: what they hold beside each other turns as they press."""
        return self._push.predictive is not None and self._push.predictive.must_place

    def begin_approach(self, T_base_sensor: Array) -> None:
        """Take note that the object is to be touched anew."""
        self._standing.begin_approach()

    def begin_sidestep(self, T_base_sensor: Array) -> None:
        """Let go of the object."""
        self._standing.let_go()
        self._steps = self._step_opposite(T_base_sensor)

    def next_goal(self, T_base_sensor: Array, T_s_f: Array | None) -> Goal | None:
        """Return where the sensor shall go next: away until the leader knows the middle, then opposite it."""
        return next(self._steps, None)

    def _step_opposite(self, T_base_sensor: Array) -> Iterator[Goal]:
        away = T_base_sensor.copy()
        away[:3, 3] -= _CLEAR_M * T_base_sensor[:3, 2]
        yield Goal(away, passes=True)
        push = self._push.predictive
        assert push is not None
        while (middle := push.located) is None:
            yield Goal(away, passes=True)
        far_m, clear_m = self._middle_m, _CLEAR_M
        if self._far is not None:
            # Where it is longer than was told, there is no room for the way to the far side as it was told.
            felt_m = middle.local((self._far.x, self._far.y))[0] + self._tip_radius_m
            clear_m = _NEAR_M if abs(felt_m - far_m) < _AGREES_M else _CLEAR_M
            far_m = max(far_m, felt_m)
        at = middle.ahead(far_m + clear_m)
        T_follower_leader = se3.inverse(self._T_leader_follower)
        T = placed(self._T_leader_follower @ away, Pose(at.x, at.y, at.heading + math.pi))
        yield Goal(T_follower_leader @ T)

    def shortfall(self) -> str:
        """Return the limit that has been reached; empty where the leader decides."""
        return self._at_limit

    def telemetry(self) -> Mapping[str, float]:
        """Return no further telemetry."""
        return {}


def build(config: DualArmPushingConfig, context: TaskContext) -> ServoTask:
    """Build the task for a cell that has ``leader`` and ``follower`` with a sensor each."""
    standing = Standing(LEADER_SENSOR)
    push, hold = Push(config, PushBounds(context, LEADER, LEADER_SENSOR), standing, followed=True), config.follower
    leader = ContactServo(LEADER, LEADER_SENSOR, config, config.reference_mm_deg, push, context)
    bases = [context.T_world_base.get(arm, np.eye(4)) for arm in (LEADER, FOLLOWER)]
    bounds = PushBounds(context, FOLLOWER, FOLLOWER_SENSOR)
    follow = Follow(config, push, bounds, Standing(FOLLOWER_SENSOR), se3.compose(se3.inverse(bases[0]), bases[1]))
    follower = ContactServo(FOLLOWER, FOLLOWER_SENSOR, hold, hold.reference_mm_deg, follow, context)
    return ServoTask("dual_arm_pushing", config, context, leader, follower)


SPEC = TaskSpec(
    name="dual_arm_pushing",
    summary="push an object to a target while a second arm holds and steadies its far side",
    config=DualArmPushingConfig,
    arms={
        LEADER: SERVO_ARM,
        FOLLOWER: SERVO_ARM,
    },
    sensors=frozenset({LEADER_SENSOR, FOLLOWER_SENSOR}),
    build=build,
    starts_free=True,
    glides=True,
    places=lambda config, start, mount: config.planned_places(LEADER),
    motions=lambda config, start, mount: servo_motions(config),
)
