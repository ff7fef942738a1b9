"""Push an object to a target with two arms: the leader pushes and steers, the follower holds the far side and goes
along, which keeps tall objects from toppling (paper 3.3.4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from pydantic import PositiveFloat

from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import ContactServo, ContactServoConfig, Six, SixGains
from touchcell.tasks.interface import TaskContext, TaskSpec
from touchcell.tasks.servoing import ServoConfig, ServoTask
from touchcell.tasks.single_arm_pushing import Push, PushConfig

LEADER: Final = "leader"
FOLLOWER: Final = "follower"
LEADER_SENSOR: Final = "leader_sensor"
FOLLOWER_SENSOR: Final = "follower_sensor"


class FollowerConfig(ContactServoConfig):
    """Parameters of the follower: object tracking at a depth that presses the object on the leader.

    Attributes:
        reference_mm_deg: contact to hold; only the components with gains count.
        active: whether it also goes ahead of the object, as fast as the leader drives and turns it, so that touch has
            only to correct that: both arms active. Else it only gives way, as in the paper.
        turn_deg_per_mm: how far the object turns per sideways motion of the leader's contact; of an 80 mm square it is
            0.9, a / (a^2 + c^2) with a from its middle to the contact and c its friction radius.
    """

    active: bool = False
    turn_deg_per_mm: PositiveFloat = 0.9
    reference_mm_deg: Six = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    kp_per_s: SixGains = (0.0, 10.0, 10.0, 10.0, 0.0, 0.0)
    ki_per_s2: SixGains = (0.0, 25.0, 25.0, 25.0, 0.0, 0.0)
    integral_zone_mm: PositiveFloat = 5.0
    integral_zone_deg: PositiveFloat = 10.0
    settle_tolerance_mm: PositiveFloat = 0.5


class DualArmPushingConfig(PushConfig, ServoConfig):
    """Parameters of dual-arm pushing; what is said of pushing is the leader's, in the leader's base frame.

    Attributes:
        align_max_mm_s: largest sideways speed: more than alone, since the follower drags behind.
        follower: the other hand's.
    """

    align_max_mm_s: PositiveFloat = 15.0
    follower: FollowerConfig = FollowerConfig()


class Follow:
    """The run of the follower: with the object, as the leader drives it. The leader says when it is done.

    Args:
        config: parameters.
        push: what the leader does; None for a follower that only gives way.
    """

    def __init__(self, config: DualArmPushingConfig, push: Push | None) -> None:
        self._push = push
        self._speed_m_s = 1e-3 * config.push_speed_mm_s
        self._middle_m = 1e-3 * config.object_center_offset_mm
        self._turn_per_m = 1e3 * np.radians(config.follower.turn_deg_per_mm)
        self._y_is_left = 1.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame: that of a point of the object as far beyond its middle as the leader
        is before it. The follower's left is the leader's right."""
        if self._push is None:
            return np.zeros(6)
        turn_rad_s = self._turn_per_m * self._push.left_m_s
        aside_m_s = self._y_is_left * self._middle_m * turn_rad_s
        return np.array([0.0, aside_m_s, -self._speed_m_s, self._y_is_left * turn_rad_s, 0.0, 0.0])

    @property
    def timeout_s(self) -> float:
        """As long as the leader takes."""
        return float("inf")

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Never done by itself."""
        self._y_is_left = -float(np.sign(now[2, 0]))
        return False

    def telemetry(self) -> Mapping[str, float]:
        """Nothing more."""
        return {}


def build(config: DualArmPushingConfig, context: TaskContext) -> ServoTask:
    """The task in a cell that has ``leader`` and ``follower`` with a sensor each."""
    push, hold = Push(config), config.follower
    leader = ContactServo(LEADER, LEADER_SENSOR, config, config.reference_mm_deg, push, context)
    follow = Follow(config, push if hold.active else None)
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
)
