"""The interlock on the wrench that an arm measures on its tool, or a force-torque sensor on itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal, Self

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, model_validator

from touchcell.control.interlocks.coverage import (
    SILENCE_S,
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    just_beyond,
    with_reading,
)
from touchcell.control.interlocks.force import FRESH_NS, LARGEST_N, LARGEST_NM, fresh_wrench, wrench_faults
from touchcell.control.interlocks.settings import LEAVE, GradedSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import AnyOf, Reading, Sustained, TimedInterlock
from touchcell.errors import suggest
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class _Norm:
    """Norm of the force or of the torque on an arm's tool. Raises ValueError without a fresh wrench."""

    arm: str
    part: slice

    def __call__(self, view: CellView) -> Iterator[Reading]:
        part = fresh_wrench(view.arms[self.arm], self.arm, view.now_ns)[self.part]
        yield Reading(self.arm, math.sqrt(float(part @ part)))


_AXES: Final = ("force_x_n", "force_y_n", "force_z_n", "torque_x_nm", "torque_y_nm", "torque_z_nm")
"""Numbers that a force-torque sensor delivers."""


@dataclass(frozen=True, slots=True)
class _SensedNorm:
    """Norm of the force or of the torque that a device measures. Raises ValueError without a fresh reading of it."""

    device: str
    part: slice

    def __call__(self, view: CellView) -> Iterator[Reading]:
        reading = view.devices[self.device].reading
        if reading is None or not 0 <= view.now_ns - reading.t_ns <= FRESH_NS:
            raise ValueError(f"{self.device} reports no fresh wrench")
        try:
            values = [reading.value[name] for name in _AXES[self.part]]
        except KeyError as error:
            raise ValueError(f"{self.device} reports no {error.args[0]}") from None
        # Every comparison with NaN is false.
        if not all(map(math.isfinite, values)):
            raise ValueError(f"{self.device} reports a wrench that is not finite")
        yield Reading(self.device, math.hypot(*values))


class WrenchConfig(GradedSettings):
    """Largest force and torque on an arm's tool or a sensor, and how long they may be exceeded. None is a fault.

    Attributes:
        arm: role of the arm that measures it.
        device: in its place, name of the force-torque sensor under ``devices:`` that measures it.
        limit_n: largest norm of the force.
        limit_nm: largest norm of the torque.
        hold_ms: time for which either may be exceeded.
    """

    kind: Literal["wrench"]
    arm: str | None = None
    device: str | None = None
    limit_n: PositiveFloat
    limit_nm: PositiveFloat
    hold_ms: NonNegativeFloat = 0.0

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.arm is None) == (self.device is None):
            raise ValueError("name either the arm or the device that measures the wrench")
        return self

    @property
    def measures(self) -> frozenset[str]:
        """The measurement that it needs of its arm."""
        return frozenset() if self.arm is None else frozenset({"wrench"})

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return a force and a torque that are too large, and a wrench that is missing."""
        source = self.arm or self.device or ""

        def beyond(pushed: Callable[[Array], Change], free: Change) -> Iterator[Fault]:
            for first, key, limit, most, unit in (
                (0, "limit_n", self.limit_n, LARGEST_N, "N"),
                (3, "limit_nm", self.limit_nm, LARGEST_NM, "N m"),
            ):
                wrench = np.zeros(6)
                wrench[first] = value = just_beyond(limit, most)
                hint = f"lower it below {most:g}"
                asked, allowed = f"{value:.3g} {unit}", f"{limit:g} {unit}"
                yield Fault(source, asked, allowed, pushed(wrench), free, key=key, hint=hint)

        if self.arm is not None:
            return wrench_faults(self.arm, facts, beyond)
        return self._faults_of_device(self.device or "", facts, beyond)

    @staticmethod
    def _faults_of_device(
        device: str, facts: CellFacts, beyond: Callable[[Callable[[Array], Change], Change], Iterator[Fault]]
    ) -> Iterator[Fault | CannotTrip]:
        if device not in facts.devices:
            yield CannotTrip(device, "no device of this name is read", "device", suggest(device, facts.devices))
            return

        def pushed(wrench: Array) -> Change:
            values = dict(zip(_AXES, wrench.tolist(), strict=True))
            return lambda view, t_s: with_reading(view, device, **values)

        yield from beyond(pushed, pushed(np.zeros(6)))

        def silent(view: CellView, t_s: float) -> CellView:
            return with_reading(view, device, t_s, **dict.fromkeys(_AXES, 0.0))

        limit = f"{1e-6 * FRESH_NS:g} ms"
        yield Fault(device, "silent", limit, silent, pushed(np.zeros(6)), within_s=SILENCE_S, by_error=True)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on force and torque."""

        def rule(part: slice, what: str, limit: float, unit: str) -> Sustained:
            measure = _SensedNorm(self.device, part) if self.device is not None else _Norm(self.arm or "", part)
            hold_s = 1e-3 * self.hold_ms
            return Sustained(name, self.level, measure, what, limit, LEAVE * limit, unit, hold_s)

        force = rule(slice(0, 3), "force on the tool", self.limit_n, "N")
        torque = rule(slice(3, 6), "torque on the tool", self.limit_nm, "N m")
        return AnyOf(name, self.level, (force, torque))


WRENCH = InterlockSpec("wrench", "force and torque on an arm's tool or a sensor stay below limits", WrenchConfig)
