"""Push an object to a target with two arms: the leader pushes and steers, the follower holds the far side and goes
along, which keeps tall objects from toppling (paper 3.3.4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from pydantic import PositiveFloat

from geometry.types import Array
from tasks.hand import Hand, HandConfig, Six, SixGains
from tasks.interface import TaskContext, TaskSpec
from tasks.servoing import ServoConfig, ServoTask
from tasks.single_arm_pushing import Push, PushConfig

LEADER: Final = "leader"
FOLLOWER: Final = "follower"
LEADER_SENSOR: Final = "leader_sensor"
FOLLOWER_SENSOR: Final = "follower_sensor"


class FollowerConfig(HandConfig):
    """Parameters of the follower: object tracking at a depth that presses the object on the leader.

    Attributes:
        reference_mm_deg: contact to hold; only the components with gains count.
    """

    reference_mm_deg: Six = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    kp_per_s: SixGains = (0.0, 10.0, 10.0, 10.0, 0.0, 0.0)
    ki_per_s2: SixGains = (0.0, 25.0, 25.0, 25.0, 0.0, 0.0)
    integral_zone_mm: PositiveFloat = 5.0
    integral_zone_deg: PositiveFloat = 10.0
    settle_tolerance_mm: PositiveFloat = 0.5


class DualArmPushingConfig(PushConfig, ServoConfig):
    """Parameters of dual-arm pushing; what is said of pushing is the leader's, in the leader's base frame.

    Attributes:
        follower: the other hand's.
    """

    follower: FollowerConfig = FollowerConfig()


class Follow:
    """The run of the follower: nothing of its own. The leader says when it is done."""

    @property
    def feedforward(self) -> Array:
        """No twist (6,): the object leads."""
        return np.zeros(6)

    @property
    def timeout_s(self) -> float:
        """As long as the leader takes."""
        return float("inf")

    def advance(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Never done by itself."""
        return False

    def telemetry(self) -> Mapping[str, float]:
        """Nothing more."""
        return {}


def build(config: DualArmPushingConfig, context: TaskContext) -> ServoTask:
    """The task in a cell that has ``leader`` and ``follower`` with a sensor each."""
    leader = Hand(LEADER, LEADER_SENSOR, config, config.reference_mm_deg, Push(config), context)
    hold = config.follower
    follower = Hand(FOLLOWER, FOLLOWER_SENSOR, hold, hold.reference_mm_deg, Follow(), context)
    return ServoTask("dual_arm_pushing", config, context, leader, follower)


SPEC = TaskSpec(
    name="dual_arm_pushing",
    summary="push an object to a target while a second arm holds and steadies its far side",
    config=DualArmPushingConfig,
    arms={
        LEADER: frozenset({"TcpSource", "TwistSink", "Stoppable"}),
        FOLLOWER: frozenset({"TcpSource", "TwistSink", "Stoppable"}),
    },
    sensors=frozenset({LEADER_SENSOR, FOLLOWER_SENSOR}),
    build=build,
)
