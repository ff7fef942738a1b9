"""Planning scene: base poses and collision bodies of the arms, and the obstacles, for interlocks on several arms."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from touchcell.control.interlocks.collision import Box, Capsule
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import ArmView
from touchcell.geometry import se3
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.control.interlocks.interlock import Interlock
    from touchcell.control.interlocks.timers import TimedInterlock
    from touchcell.drivers.kinematics.chain import DifferentialIk


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Collision body of an arm, and the pose of its base.

    Attributes:
        T_world_base: pose (4, 4) of its base.
        capsules: its parts; frame 0 is the base, frames from 1 on are the links, the last is the tool.
        kinematics: of an arm whose links have capsules; None where only base and tool are frames.
        link_count: number of links with frames.
    """

    T_world_base: Array
    capsules: Sequence[Capsule]
    kinematics: Callable[[], DifferentialIk | None] = lambda: None
    link_count: int = 0

    def frames(self, arm: ArmView, ahead_s: float = 0.0, *, measured: bool = False) -> Array:
        """Return (link_count + 2, 4, 4) frames in the world as measured, or ``ahead_s`` later.

        Args:
            arm: in this cycle.
            ahead_s: how much later.
            measured: moved on as it is measured to move; else as its command would move it.
        """
        T_base_tcp = arm.state.value.T_base_tcp
        twist = (arm.state.value.twist if measured else arm.commanded_twist()) if ahead_s else None
        ik = self.kinematics()
        T = np.empty((self.link_count + 2, 4, 4))
        T[0] = np.eye(4)
        if ik is not None:
            if arm.joints is None:
                raise ValueError("the joint angles were not read")
            q = arm.joints.value.q
            if twist is not None:
                q = q + ahead_s * (arm.joints.value.dq if measured else ik.solve(q, twist).dq)
            T[1:-1] = ik.chain.link_poses(q)
        T[-1] = T_base_tcp
        if twist is not None:
            T[-1, :3, :3] = se3.exp(np.concatenate([np.zeros(3), ahead_s * twist[3:]]))[:3, :3] @ T_base_tcp[:3, :3]
            T[-1, :3, 3] += ahead_s * twist[:3]
        placed: Array = self.T_world_base @ T
        return placed


@dataclass(frozen=True, slots=True)
class PlanningScene:
    """Data besides the view that interlocks on several arms need.

    Attributes:
        T_world_base: pose (4, 4) of each arm's base, by role; one that is not named stands at the world's origin.
        bodies: collision bodies of the arms, by role, where an interlock needs them.
        boxes: static obstacles.
    """

    T_world_base: Mapping[str, Array] = field(default_factory=dict)
    bodies: Mapping[str, Body] = field(default_factory=dict)
    boxes: Sequence[Box] = ()


class SpatialInterlockConfig(InterlockSettings):
    """Settings of an interlock that needs the planning scene."""

    @abstractmethod
    def build_in_scene(
        self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene
    ) -> Interlock | TimedInterlock:
        """Return the interlock. Raises ConfigError for an arm, sensor or body that the cell does not have."""
