"""Hold-to-run: arms move only while an operator holds an enabling device in its middle position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import PositiveFloat

from touchcell.control.interlocks.boundary import REST_M_S, REST_RAD_S
from touchcell.control.interlocks.coverage import SILENCE_S, CannotTrip, CellFacts, Change, Fault, with_motion
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.enabling import EnablingPosition
from touchcell.drivers.core.samples import Stamped
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class HoldToRun:
    """Require a fresh ENABLED position while any arm moves or is commanded to."""

    name: str
    severity: Severity
    limit_s: float

    def check(self, view: CellView) -> Violation | None:
        """Return a violation for the first arm that moves, or is commanded to, while it is not enabled."""
        problem = self._problem(view)
        if problem is None:
            return None
        for role, arm in view.arms.items():
            if _moves(arm):
                return Violation(self.name, self.severity, role, problem, view.now_ns)
        return None

    def _problem(self, view: CellView) -> str | None:
        sample = view.enabling
        if sample is None:
            return "there is no enabling device"
        if not 0 <= view.now_ns - sample.t_ns <= round(1e9 * self.limit_s):
            age_ms = 1e-6 * (view.now_ns - sample.t_ns)
            return f"the enabling device was read {age_ms:.0f} ms ago, limit {1e3 * self.limit_s:g} ms"
        if sample.value is not EnablingPosition.ENABLED:
            return f"the enabling device is {sample.value.value}"
        return None


def _moves(arm: ArmView) -> bool:
    if arm.command is not None and np.any(arm.command.twist):
        return True
    twist = arm.state.value.twist
    return bool(np.linalg.norm(twist[:3]) > REST_M_S or np.linalg.norm(twist[3:]) > REST_RAD_S)


class HoldToRunConfig(InterlockSettings):
    """Arms move only while an enabling device is held.

    Attributes:
        limit_ms: largest age of its position.
    """

    kind: Literal["hold_to_run"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each arm moving while the device is released, compressed, and silent."""
        if not facts.enabling_device:
            yield CannotTrip("", "the cell has no enabling device", "kind", "give the run one")
            return
        moving = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])

        def held(position: EnablingPosition, role: str, *, silent: bool = False) -> Change:
            def change(view: CellView, t_s: float) -> CellView:
                t_ns = view.now_ns - round(1e9 * max(t_s, 0.0)) if silent else view.now_ns
                return replace(with_motion(view, role, twist=moving), enabling=Stamped(position, t_ns, 0))

            return change

        for role in facts.arms:
            before = held(EnablingPosition.ENABLED, role)
            for position in (EnablingPosition.RELEASED, EnablingPosition.COMPRESSED):
                yield Fault(role, f"moves while {position.value}", "-", held(position, role), before)
            silent = held(EnablingPosition.ENABLED, role, silent=True)
            limit = f"{self.limit_ms:g} ms"
            yield Fault(role, "moves while silent", limit, silent, before, within_s=SILENCE_S, key="limit_ms")

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``HoldToRun`` interlock."""
        return HoldToRun(name, self.level, 1e-3 * self.limit_ms)


HOLD_TO_RUN = InterlockSpec("hold_to_run", "arms move only while an enabling device is held", HoldToRunConfig)
