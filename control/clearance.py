"""The interlock that keeps arms apart from each other, from what stands around, and from themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np
from pydantic import PositiveFloat, model_validator

from control.collision import Box, Capsule, Clearances, Pair
from control.settings import InterlockSettings
from control.view import ArmView, CellView
from control.violation import Severity, Violation
from drivers.errors import ConfigError
from drivers.kinematics import DifferentialIk
from geometry import se3
from geometry.types import Array

_AHEAD_S = 0.01
_NEGLIGIBLE_M = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """What an arm looks like, and where it stands.

    Attributes:
        T_world_base: pose (4, 4) of its base.
        capsules: its parts; frame 0 is the base, frames from 1 on are the links, the last is the tool.
        kinematics: of an arm whose links have capsules; None where only base and tool are frames.
        link_count: how many links that are.
    """

    T_world_base: Array
    capsules: Sequence[Capsule]
    kinematics: Callable[[], DifferentialIk | None] = lambda: None
    link_count: int = 0

    def frames(self, arm: ArmView, ahead_s: float = 0.0) -> Array:
        """(link_count + 2, 4, 4) in the world as measured, or as its command would move them within ``ahead_s``."""
        T_base_tcp, twist = arm.state.value.T_base_tcp, arm.commanded_twist() if ahead_s else None
        ik = self.kinematics()
        T = np.empty((self.link_count + 2, 4, 4))
        T[0] = np.eye(4)
        if ik is not None:
            if arm.joints is None:
                raise ValueError("nobody has read the joints")
            q = arm.joints.value.q
            if twist is not None:
                q = q + ahead_s * ik.solve(q, twist).dq
            T[1:-1] = ik.chain.link_poses(q)
        T[-1] = T_base_tcp
        if twist is not None:
            T[-1, :3, :3] = se3.exp(np.concatenate([np.zeros(3), ahead_s * twist[3:]]))[:3, :3] @ T_base_tcp[:3, :3]
            T[-1, :3, 3] += ahead_s * twist[:3]
        placed: Array = self.T_world_base @ T
        return placed


@dataclass(frozen=True, slots=True, eq=False)
class Clearance:
    """Nothing comes nearer to an arm than ``limit_m``, and towards what is nearer than ``slow_m`` it goes slowly.

    Motion that takes the two apart is allowed. What counts is where a command would lead within 10 ms.
    """

    name: str
    severity: Severity
    bodies: Mapping[str, Body]
    clearances: Clearances
    limit_m: float
    slow_m: float

    def check(self, view: CellView) -> Violation | None:
        """The nearest two of those that are too near and do not go apart."""
        apart = self.clearances.distances(self._frames(view, 0.0))
        if not np.min(apart, initial=np.inf) < self.slow_m:
            return None
        commanded = any(view.arms[role].command is not None for role in self.bodies)
        change = self.clearances.distances(self._frames(view, _AHEAD_S)) - apart if commanded else np.zeros_like(apart)
        wrong = (apart < self.limit_m) & (change <= _NEGLIGIBLE_M)
        wrong |= (apart < self.slow_m) & (change < -_NEGLIGIBLE_M)
        if not wrong.any():
            return None
        nearest = int(np.argmin(np.where(wrong, apart, np.inf)))
        return self._violation(view, self.clearances.pairs[nearest], float(apart[nearest]))

    def _frames(self, view: CellView, ahead_s: float) -> Array:
        return np.concatenate([body.frames(view.arms[role], ahead_s) for role, body in self.bodies.items()])

    def _violation(self, view: CellView, pair: Pair, apart_m: float) -> Violation:
        too_near = apart_m < self.limit_m
        limit_m = self.limit_m if too_near else self.slow_m
        whose = "" if pair.other_arm is None else "its own " if pair.other_arm == pair.arm else f"{pair.other_arm}'s "
        what = "limit" if too_near else "slow below"
        return Violation(
            self.name,
            self.severity if too_near else Severity.LIMIT,
            pair.arm,
            f"{pair.part} is {1e3 * apart_m:.1f} mm from {whose}{pair.other}, {what} {1e3 * limit_m:g} mm",
            view.now_ns,
            value=apart_m,
            limit=limit_m,
            unit="m",
            may_last=True,
        )


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a clearance is about: the arms' bodies by role, and what stands around them."""

    bodies: Mapping[str, Body] = field(default_factory=dict)
    boxes: Sequence[Box] = ()


class ClearanceConfig(InterlockSettings):
    """Least distance of every arm from the others, from the cell's ``obstacles:`` and from itself.

    Nearer than ``slow_mm`` motion towards each other is slowed to a quarter, for as long as it lasts.
    """

    kind: Literal["clearance"]
    limit_mm: PositiveFloat
    slow_mm: PositiveFloat

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.slow_mm < self.limit_mm:
            raise ValueError(f"slow_mm {self.slow_mm:g} is below limit_mm {self.limit_mm:g}")
        return self

    def build(self, name: str, surroundings: Surroundings) -> Clearance:
        """The rule. Raises ConfigError where there is nothing that could come near anything."""
        bodies = surroundings.bodies
        counts = {role: body.link_count + 2 for role, body in bodies.items()}
        clearances = Clearances({role: body.capsules for role, body in bodies.items()}, counts, surroundings.boxes)
        if not clearances.pairs:
            raise ConfigError(
                "there are no two things to be kept apart",
                key=f"interlocks.{name}",
                hint="give the arms a `body:`, or name `obstacles:`",
            )
        return Clearance(name, self.level, bodies, clearances, 1e-3 * self.limit_mm, 1e-3 * self.slow_mm)
