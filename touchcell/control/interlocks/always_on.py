"""Rules that every cell has without asking for them: each role is in the view, and no cycle comes late."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from pydantic import PositiveFloat

from touchcell.control.interlocks.basic import ArmStateAgeConfig, FrameAgeConfig
from touchcell.control.interlocks.coverage import SILENCE_S, CellFacts, Fault
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import InterlockState, Judgement, TimedInterlock, TimerState
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.geometry.types import Array

LATE_PERIODS: Final = 2.5
"""Periods between two cycles that scheduling alone may cause."""
LONGEST_GAP_S: Final = 0.3
"""Time between two cycles that no cell gets by default, however lax its limits of age."""
FIRST_FRAME_S: Final = 1.0
"""Time that a sensor may take until its first frame has been processed."""

_LOOP: Final = "loop"
_SINCE: Final = ""


@dataclass(frozen=True, slots=True)
class Overrun:
    """The time between two control cycles stays below the limit.

    After a hang all data is fresh again when the loop resumes: age limits alone do not reveal the gap.
    """

    name: str
    severity: Severity
    limit_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The gap before this cycle if it is too long, and the time of this cycle; waiting for a reset counts not."""
        if not view.at_work:
            return None, {}
        before, now = past.get(_LOOP), {_LOOP: TimerState(view.now_ns)}
        gap_s = 0.0 if before is None else (view.now_ns - before.since_ns) * 1e-9
        if gap_s <= self.limit_s:
            return None, now
        reason = f"no control cycle for {1e3 * gap_s:.0f} ms, limit {1e3 * self.limit_s:g} ms"
        violation = Violation(
            self.name, self.severity, _LOOP, reason, view.now_ns, value=gap_s, limit=self.limit_s, unit="s"
        )
        return violation, now


@dataclass(frozen=True, slots=True)
class Missing:
    """Every arm and every sensor of the cell is in the view; a sensor that has not been yet has a second for it."""

    name: str
    severity: Severity
    arms: frozenset[str]
    sensors: frozenset[str]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The first role that is missing, and since when sensors have been missing that were never seen."""
        if _SINCE not in past:
            past = {_SINCE: TimerState(view.now_ns)}
        state = past
        if not view.sensors.keys() <= past.keys():
            state = {**past, **dict.fromkeys(view.sensors, TimerState(view.now_ns))}
        if self.arms <= view.arms.keys() and self.sensors <= view.sensors.keys():
            return None, state
        first_ns = past[_SINCE].since_ns
        may_be_missing = (view.now_ns - first_ns) * 1e-9 <= FIRST_FRAME_S
        missing = sorted(self.arms - view.arms.keys()) + sorted(
            role for role in self.sensors - view.sensors.keys() if role in past or not may_be_missing
        )
        if not missing:
            return None, state
        return Violation(self.name, self.severity, missing[0], "is missing from the view", view.now_ns), state


class OverrunConfig(InterlockSettings):
    """Longest time between two control cycles, in place of the one that follows from rate and limits of age.

    Attributes:
        limit_ms: longest time from one cycle to the next.
    """

    kind: Literal["overrun"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault]:
        """Return a loop that hangs for a second."""
        hint = f"lower it below {1e3 * SILENCE_S:g} ms"
        yield Fault(_LOOP, "hangs", f"{self.limit_ms:g} ms", _hung, within_s=0.0, key="limit_ms", hint=hint)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Overrun`` interlock."""
        return Overrun(name, self.level, 1e-3 * self.limit_ms)


def _hung(view: CellView, t_s: float) -> CellView:
    """Return a cycle that comes a second too late."""
    return replace(view, now_ns=view.now_ns + round(1e9 * SILENCE_S))


OVERRUN = InterlockSpec("overrun", "no control cycle comes late; always on, with a limit of its own", OverrunConfig)


def default_overrun_s(rate_hz: float, settings: Collection[InterlockSettings]) -> float:
    """Longest time between two cycles of a cell that does not set it.

    It is the smallest limit of a frame's or an arm state's age, at most ``LONGEST_GAP_S`` and at least
    ``LATE_PERIODS`` periods.
    """
    ages_s = [1e-3 * each.limit_ms for each in settings if isinstance(each, ArmStateAgeConfig | FrameAgeConfig)]
    return max(LATE_PERIODS / rate_hz, min([LONGEST_GAP_S, *ages_s]))


def always_on(
    rate_hz: float,
    settings: Collection[InterlockSettings],
    *,
    moved: bool,
    arms: Collection[str],
    sensors: Collection[str],
) -> Sequence[Interlock | TimedInterlock]:
    """The rules of a cell beyond those of its file.

    Args:
        rate_hz: control cycles per second.
        settings: interlocks of its file.
        moved: whether its task moves an arm; without one no cycle can come too late.
        arms, sensors: roles.
    """
    rules: list[Interlock | TimedInterlock] = [
        Missing("missing", Severity.FAULT, frozenset(arms), frozenset(sensors)),
    ]
    if moved and not any(isinstance(each, OverrunConfig) for each in settings):
        rules.append(Overrun("overrun", Severity.TRIP, default_overrun_s(rate_hz, settings)))
    return rules
