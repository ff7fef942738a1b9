"""Interlock that keeps arms clear of each other, of obstacles, and of themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from pydantic import PositiveFloat, model_validator

from touchcell.control.interlocks.collision import Clearances, Pair
from touchcell.control.interlocks.planning_scene import Body, PlanningScene, SpatialInterlockConfig
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array

_AHEAD_S = 0.01
_NEGLIGIBLE_M = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Clearance:
    """Keep every arm at least ``limit_m`` from everything, and slow its approach to what is nearer than ``slow_m``.

    Motion that increases the distance is allowed. The check uses the pose to which a command would lead within 10 ms.
    """

    name: str
    severity: Severity
    bodies: Mapping[str, Body]
    clearances: Clearances
    limit_m: float
    slow_m: float

    def check(self, view: CellView) -> Violation | None:
        """Return a violation for the nearest pair that is too near and not separating."""
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
            escalates=False,
        )


class ClearanceConfig(SpatialInterlockConfig):
    """Smallest distance of every arm to the others, to the cell's ``obstacles:`` and to itself.

    Nearer than ``slow_mm``, approaching motion is slowed to a quarter for as long as it continues.

    Attributes:
        limit_mm: smallest distance.
        slow_mm: distance below which approaching motion is slowed to a quarter.
    """

    kind: Literal["clearance"]
    limit_mm: PositiveFloat
    slow_mm: PositiveFloat

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.slow_mm < self.limit_mm:
            raise ValueError(f"slow_mm {self.slow_mm:g} is below limit_mm {self.limit_mm:g}")
        return self

    def build_in_scene(self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene) -> Clearance:
        """Return the ``Clearance`` interlock. Raises ConfigError if there are no two bodies that could collide."""
        bodies = planning_scene.bodies
        counts = {role: body.link_count + 2 for role, body in bodies.items()}
        clearances = Clearances({role: body.capsules for role, body in bodies.items()}, counts, planning_scene.boxes)
        if not clearances.pairs:
            raise ConfigError(
                "there are no two things to be kept apart",
                key=f"interlocks.{name}",
                hint="give the arms a `body:`, or name `obstacles:`",
            )
        return Clearance(name, self.level, bodies, clearances, 1e-3 * self.limit_mm, 1e-3 * self.slow_mm)


CLEARANCE = InterlockSpec("clearance", "arms keep clear of each other, obstacles and themselves", ClearanceConfig)
