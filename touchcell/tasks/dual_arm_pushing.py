"""Push an object to a target with two arms (paper 3.3.4).

The leader pushes and steers; the follower holds the far side and moves along, which keeps tall objects from toppling.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import ContactServo, ContactServoConfig, Six, SixGains
from touchcell.tasks.interface import CONTACT_DEPTH, TaskContext, TaskSpec
from touchcell.tasks.predictive_push import twist_in_sensor
from touchcell.tasks.servoing import ServoConfig, ServoTask
from touchcell.tasks.single_arm_pushing import Push, PushConfig

LEADER: Final = "leader"
FOLLOWER: Final = "follower"
LEADER_SENSOR: Final = "leader_sensor"
FOLLOWER_SENSOR: Final = "follower_sensor"


class FollowerConfig(ContactServoConfig):
    """Parameters of the follower: object tracking at a depth that presses the object onto the leader.

    Attributes:
        reference_mm_deg: contact to hold; only the components with gains count.
        active: if True, its feedforward also moves it with the object, as fast as the leader drives and turns it, so
            that
            touch only corrects the rest: both arms are active. If False, it only complies, as in the paper.
        turn_deg_per_mm: rotation of the object per lateral motion of the leader's contact; of an 80 mm square it is
            0.9, a / (a^2 + c^2) with a from its centre to the contact and c its friction radius.
    """

    active: bool = True
    turn_deg_per_mm: PositiveFloat = 0.9
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
        steering: as for a single arm. The model of ``predictive`` has one contact: where the arms do not press opposite
            each other the follower's force makes it estimate a wrong centre, and the push end beside its target.
        follower: parameters of the follower's servo.
    """

    align_max_mm_s: PositiveFloat = 15.0
    steering: Literal["predictive", "bearing"] = "bearing"
    follower: FollowerConfig = FollowerConfig()


class Follow:
    """Behavior of the follower: moves with the object as the leader drives it. The leader decides when it is done.

    Args:
        config: parameters.
        push: the leader's behavior; None for a follower that only complies.
    """

    def __init__(self, config: DualArmPushingConfig, push: Push | None) -> None:
        self._push = push
        self._speed_m_s = 1e-3 * config.push_speed_mm_s
        self._middle_m = 1e-3 * config.object_center_offset_mm
        self._turn_per_m = 1e3 * np.radians(config.follower.turn_deg_per_mm)
        self._y_is_left = 1.0

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame.

        It is that of a point of the object as far beyond its centre as the leader is before it. The follower's left is
        the leader's right.
        """
        if self._push is None:
            return np.zeros(6)
        if (motion := self._push.object_motion) is not None:
            left_m_s = motion.left_m_s + motion.turn_rad_s * self._middle_m
            return twist_in_sensor(-motion.ahead_m_s, -left_m_s, motion.turn_rad_s, self._y_is_left)
        turn_rad_s = self._turn_per_m * self._push.left_m_s
        aside_m_s = self._y_is_left * self._middle_m * turn_rad_s
        return np.array([0.0, aside_m_s, -self._speed_m_s, self._y_is_left * turn_rad_s, 0.0, 0.0])

    @property
    def timeout_s(self) -> float:
        """Infinite: the leader's timeout applies."""
        return float("inf")

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Return False: it never finishes by itself."""
        self._y_is_left = -float(np.sign(now[2, 0]))
        return False

    def shortfall(self) -> str:
        """Return nothing: the leader decides."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return no further telemetry."""
        return {}


def build(config: DualArmPushingConfig, context: TaskContext) -> ServoTask:
    """Build the task for a cell that has ``leader`` and ``follower`` with a sensor each."""
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
