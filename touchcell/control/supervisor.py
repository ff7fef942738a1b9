"""The supervisor: checks every command before it is sent, and decides whether motion is allowed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from touchcell.control.interlocks.basic import Finite
from touchcell.control.interlocks.errors import SafetyTrip
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.timers import NO_MARKS, InterlockState, Levelled, TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch, LatchState, ResetDone, ResetRefused
from touchcell.control.rest import RestMonitor
from touchcell.drivers.core.device import OperatorToken
from touchcell.errors import described

LIMIT_FOR_NS: Final = 300_000_000
"""An interlock that limits for longer trips, whatever its subjects were and however it flickered."""

FORGIVEN: Final = 4
"""While an interlock does not limit, its counted time decreases this many times more slowly than it increased."""

REDUCED: Final = 0.25
"""Speed scaling while a LIMIT violation is present."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision of the supervisor for one cycle.

    Attributes:
        allow: True if the commands may be sent. If not, every arm is commanded to stop.
        speed: factor in [0, 1] by which their speed is scaled.
        violations: all violations of this cycle.
        trip: the first cause while the latch is not clear, as an error for the caller to raise.
    """

    allow: bool
    speed: float
    violations: tuple[Violation, ...]
    trip: SafetyTrip | None


@dataclass(frozen=True, slots=True)
class _Limiting:
    """Counted time of one interlock's LIMIT violations, and True if it limits now."""

    total_ns: int
    now: bool


class _Remembered:
    """A timed interlock with its state, wrapped as a stateless one."""

    def __init__(self, rule: TimedInterlock) -> None:
        self.name = rule.name
        self.severity = rule.severity
        self._rule = rule
        self._levelled = rule if isinstance(rule, Levelled) else None
        self._past: InterlockState = NO_MARKS

    def check(self, view: CellView) -> Violation | None:
        violation, self._past = self._rule.evaluate(view, self._past)
        return violation

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        if self._levelled is not None:
            yield from self._levelled.levels(view, self._past)


class Supervisor:
    """Apply the interlocks to each cycle and hold the latch.

    Finiteness of all numbers is checked first, whatever the configuration: every comparison with NaN is false, so the
    other interlocks would pass it. An interlock that raises is a fault, not a pass. The state of timed interlocks is
    kept in ``_Remembered`` only.

    Args:
        interlocks: the configured interlocks.
        latch: stores their violations.
        rest_m_s, rest_rad_s: an arm whose measured speeds are at most these is at rest; see ``RestMonitor``.
    """

    def __init__(
        self,
        interlocks: Sequence[Interlock | TimedInterlock],
        latch: Latch,
        *,
        rest_m_s: float = 1e-3,
        rest_rad_s: float = 1e-2,
    ) -> None:
        self._finite = Finite()
        # Classified once: isinstance with a Protocol costs more than most interlocks.
        self._rules = tuple(_Remembered(rule) if isinstance(rule, TimedInterlock) else rule for rule in interlocks)
        self._levelled = tuple((rule.name, rule) for rule in self._rules if isinstance(rule, Levelled))
        self._latch = latch
        self._rest = RestMonitor(rest_m_s, rest_rad_s)
        self._limiting: dict[str, _Limiting] = {}
        self._reviewed_ns = 0
        self._view: CellView | None = None

    @property
    def latch(self) -> Latch:
        """The latch, read-only."""
        return self._latch

    def review(self, view: CellView, alarms: Sequence[Violation] = ()) -> Verdict:
        """Check ``view``, latch its violations, and decide whether its commands may be sent. Never raises.

        Args:
            view: snapshot of this cycle.
            alarms: violations from other sources, such as the watchdog; used as they are.
        """
        self._view = view
        self._rest.note(view)
        violations = (*alarms, *self._violations(view))
        self._latch.update(violations)
        first = self._latch.first_cause
        return Verdict(
            allow=self._latch.state is LatchState.CLEAR,
            speed=REDUCED if violations else 1.0,
            violations=violations,
            trip=None if first is None else first.as_error(),
        )

    def levels(self) -> list[tuple[str, Level]]:
        """Return what is on its way to the limits of which interlocks, as of the latest review.

        Interlocks that cannot tell, and one that raises, have nothing. Never raises.
        """
        found: list[tuple[str, Level]] = []
        if self._view is None:
            return found
        for name, rule in self._levelled:
            # What is only shown disturbs nothing.
            with suppress(BaseException):
                found += [(name, level) for level in rule.levels(self._view, NO_MARKS)]
        return found

    def reset(self, token: OperatorToken, view: CellView, alarms: Sequence[Violation] = ()) -> ResetDone | ResetRefused:
        """Clear the latch at an operator's request, judged on the current ``view`` and ``alarms``; nothing moves."""
        self._latch.update((*alarms, *self._violations(view)))
        self._rest.note(view)
        outcome = self._latch.reset(
            token,
            at_rest=self._rest.at_rest(view),
            commanded=any(arm.command is not None and np.any(arm.command.twist) for arm in view.arms.values()),
        )
        if isinstance(outcome, ResetDone):
            self._limiting = {}
        return outcome

    def _violations(self, view: CellView) -> tuple[Violation, ...]:
        if (first := _checked(self._finite, view)) is not None:
            return (first,)
        found = [violation for rule in self._rules if (violation := _checked(rule, view)) is not None]
        return self._escalated(found, view.now_ns)

    def _escalated(self, found: Sequence[Violation], now_ns: int) -> tuple[Violation, ...]:
        """Return ``found`` with a trip in place of each LIMIT violation of an interlock that has limited for too long.

        Time is counted per interlock, not per subject: which of two sensors is the deeper one may change in every
        cycle. It is counted from one review to the next by what the first of them found, and forgotten more slowly than
        it is counted, so that a value that hops about its limit trips as well.
        """
        passed_ns, self._reviewed_ns = now_ns - self._reviewed_ns, now_ns
        names = {v.interlock for v in found if v.severity is Severity.LIMIT and v.escalates}
        if not names and not self._limiting:
            return tuple(found)
        counted = {}
        for name in names | self._limiting.keys():
            before = self._limiting.get(name, _Limiting(0, False))
            total_ns = before.total_ns + (passed_ns if before.now else -(passed_ns // FORGIVEN))
            total_ns = min(max(total_ns, 0), 2 * LIMIT_FOR_NS)
            if total_ns or name in names:
                counted[name] = _Limiting(total_ns, name in names)
        self._limiting = counted
        lasting = {name for name in names if counted[name].total_ns > LIMIT_FOR_NS}
        return tuple(
            replace(v, severity=Severity.TRIP, reason=f"{v.reason}, limiting for over {1e-6 * LIMIT_FOR_NS:g} ms")
            if v.interlock in lasting and v.severity is Severity.LIMIT and v.escalates
            else v
            for v in found
        )


def _checked(interlock: Interlock, view: CellView) -> Violation | None:
    try:
        return interlock.check(view)
    except BaseException as error:
        reason = f"the interlock could not be evaluated: {described(error)}"
        return Violation(interlock.name, Severity.FAULT, "cell", reason, view.now_ns, raised=True)
