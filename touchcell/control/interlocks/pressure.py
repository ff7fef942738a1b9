"""The interlock on contact pressure: force on the tool over the contact area, for the body regions of ISO/TS 15066."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field, PositiveFloat, field_validator

from touchcell.control.interlocks.body_regions import BODY_REGIONS, BodyRegion
from touchcell.control.interlocks.coverage import CannotTrip, CellFacts, Change, Fault, just_beyond
from touchcell.control.interlocks.force import LARGEST_N, fresh_wrench, wrench_faults
from touchcell.control.interlocks.settings import LEAVE, GradedSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import AnyOf, Reading, Sustained, TimedInterlock
from touchcell.errors import suggest
from touchcell.geometry.types import Array

TRANSIENT_S: Final = 0.5
"""Contact that lasts longer is quasi-static (ISO/TS 15066:2016, 5.5.4)."""


@dataclass(frozen=True, slots=True)
class _Pressure:
    """Force on an arm's tool over an area, N/cm2; over 1 it is the force. Raises ValueError without a fresh wrench."""

    arm: str
    area_cm2: float

    def __call__(self, view: CellView) -> Iterator[Reading]:
        force = fresh_wrench(view.arms[self.arm], self.arm, view.now_ns)[:3]
        yield Reading(self.arm, math.sqrt(float(force @ force)) / self.area_cm2)


class PressureConfig(GradedSettings):
    """Largest contact force and pressure at every body region that the tool may touch.

    The transient limits count at once, the quasi-static ones after half a second.

    Attributes:
        arm: role of the arm.
        regions: body regions of ISO/TS 15066 that the tool may touch.
        contact_area_mm2: smallest area with which the tool can touch: that of its sharpest edge, not of its face.
    """

    kind: Literal["pressure"]
    arm: str
    regions: tuple[str, ...] = Field(min_length=1)
    contact_area_mm2: PositiveFloat

    @field_validator("regions")
    @classmethod
    def _are_known(cls, regions: tuple[str, ...]) -> tuple[str, ...]:
        for region in regions:
            if region not in BODY_REGIONS:
                raise ValueError(f"no body region {region!r}; {suggest(region, BODY_REGIONS)}")
        return regions

    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the least (force N, pressure N/cm2) of the regions: in transient, then in quasi-static contact."""
        regions = [BODY_REGIONS[name] for name in self.regions]
        transient = (
            min(each.force_n * _multiple(each) for each in regions),
            min(each.pressure_n_cm2 * _multiple(each) for each in regions),
        )
        return transient, (min(each.force_n for each in regions), min(each.pressure_n_cm2 for each in regions))

    @property
    def measures(self) -> frozenset[str]:
        """The measurement that it needs of its arm."""
        return frozenset({"wrench"})

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return a push that is too hard at once, one that is too hard for long, and a wrench that is missing."""
        area_cm2 = 0.01 * self.contact_area_mm2

        def beyond(pushed: Callable[[Array], Change], free: Change) -> Iterator[Fault]:
            for limits, what, within_s in zip(self.limits(), ("at once", "for long"), (0.1, 1.0), strict=True):
                limit_n = min(limits[0], limits[1] * area_cm2)
                force_n = just_beyond(limit_n, LARGEST_N)
                wrench = np.array([force_n, 0.0, 0.0, 0.0, 0.0, 0.0])
                yield Fault(
                    self.arm,
                    f"{force_n:.3g} N {what}",
                    f"{limit_n:.3g} N",
                    pushed(wrench),
                    free,
                    within_s=within_s,
                    key="contact_area_mm2",
                )

        return wrench_faults(self.arm, facts, beyond)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on contact force and pressure."""
        rules = []
        for (force_n, pressure_n_cm2), hold_s in zip(self.limits(), (0.0, TRANSIENT_S), strict=True):
            for area_cm2, what, limit, unit in (
                (1.0, "contact force", force_n, "N"),
                (0.01 * self.contact_area_mm2, "contact pressure", pressure_n_cm2, "N/cm2"),
            ):
                measure = _Pressure(self.arm, area_cm2)
                rules.append(Sustained(name, self.level, measure, what, limit, LEAVE * limit, unit, hold_s))
        return AnyOf(name, self.level, tuple(rules))


def _multiple(region: BodyRegion) -> float:
    return 1.0 if region.transient is None else region.transient


PRESSURE = InterlockSpec(
    "pressure", "contact force and pressure stay below those of body regions (ISO/TS 15066)", PressureConfig
)
