"""The interlock on the wrench that an arm measures on its tool."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from touchcell.control.interlocks.coverage import CannotTrip, CellFacts, Change, Fault, just_beyond
from touchcell.control.interlocks.force import LARGEST_N, LARGEST_NM, fresh_wrench, wrench_faults
from touchcell.control.interlocks.settings import LEAVE, GradedSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import AnyOf, Reading, Sustained, TimedInterlock
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class _Norm:
    """Norm of the force or of the torque on an arm's tool. Raises ValueError without a fresh wrench."""

    arm: str
    part: slice

    def __call__(self, view: CellView) -> Iterator[Reading]:
        part = fresh_wrench(view.arms[self.arm], self.arm, view.now_ns)[self.part]
        yield Reading(self.arm, math.sqrt(float(part @ part)))


class WrenchConfig(GradedSettings):
    """Largest force and torque on an arm's tool, and how long they may be exceeded. A missing wrench is a fault.

    Attributes:
        arm: role of the arm.
        limit_n: largest norm of the force.
        limit_nm: largest norm of the torque.
        hold_ms: time for which either may be exceeded.
    """

    kind: Literal["wrench"]
    arm: str
    limit_n: PositiveFloat
    limit_nm: PositiveFloat
    hold_ms: NonNegativeFloat = 0.0

    @property
    def measures(self) -> frozenset[str]:
        """The measurement that it needs of its arm."""
        return frozenset({"wrench"})

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return a force and a torque that are too large, and a wrench that is missing."""

        def beyond(pushed: Callable[[Array], Change], free: Change) -> Iterator[Fault]:
            for first, key, limit, most, unit in (
                (0, "limit_n", self.limit_n, LARGEST_N, "N"),
                (3, "limit_nm", self.limit_nm, LARGEST_NM, "N m"),
            ):
                wrench = np.zeros(6)
                wrench[first] = value = just_beyond(limit, most)
                hint = f"lower it below {most:g}"
                yield Fault(
                    self.arm, f"{value:.3g} {unit}", f"{limit:g} {unit}", pushed(wrench), free, key=key, hint=hint
                )

        return wrench_faults(self.arm, facts, beyond)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on force and torque."""

        def rule(part: slice, what: str, limit: float, unit: str) -> Sustained:
            measure, hold_s = _Norm(self.arm, part), 1e-3 * self.hold_ms
            return Sustained(name, self.level, measure, what, limit, LEAVE * limit, unit, hold_s)

        force = rule(slice(0, 3), "force on the tool", self.limit_n, "N")
        torque = rule(slice(3, 6), "torque on the tool", self.limit_nm, "N m")
        return AnyOf(name, self.level, (force, torque))


WRENCH = InterlockSpec("wrench", "force and torque on an arm's tool stay below limits", WrenchConfig)
