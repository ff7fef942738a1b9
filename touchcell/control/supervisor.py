"""The supervisor: checks every command before it is sent, and decides whether motion is allowed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from touchcell.control.interlocks.basic import Finite
from touchcell.control.interlocks.errors import SafetyTrip
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.timers import InterlockState, TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch, LatchState, ResetDone, ResetRefused
from touchcell.drivers.core.device import OperatorToken

LIMIT_FOR_NS: Final = 300_000_000
"""A LIMIT violation that lasts longer becomes a trip."""

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


class _Remembered:
    """A timed interlock with its state, wrapped as a stateless one."""

    def __init__(self, rule: TimedInterlock) -> None:
        self.name = rule.name
        self.severity = rule.severity
        self._rule = rule
        self._past: InterlockState = {}

    def check(self, view: CellView) -> Violation | None:
        violation, self._past = self._rule.evaluate(view, self._past)
        return violation


class Supervisor:
    """Apply the interlocks to each cycle and hold the latch.

    Finiteness of all numbers is checked first, whatever the configuration: every comparison with NaN is false, so the
    other interlocks would pass it. An interlock that raises is a fault, not a pass. The state of timed interlocks is
    kept in ``_Remembered`` only.

    Args:
        interlocks: the configured interlocks.
        latch: stores their violations.
        rest_m_s, rest_rad_s: an arm whose measured speeds are at most these is at rest.
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
        self._latch = latch
        self._rest_m_s = rest_m_s
        self._rest_rad_s = rest_rad_s
        self._limited_since_ns: dict[tuple[str, str], int] = {}

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
        violations = (*alarms, *self._violations(view))
        self._latch.update(violations)
        first = self._latch.first_cause
        return Verdict(
            allow=self._latch.state is LatchState.CLEAR,
            speed=REDUCED if violations else 1.0,
            violations=violations,
            trip=None if first is None else first.as_error(),
        )

    def reset(self, token: OperatorToken, view: CellView, alarms: Sequence[Violation] = ()) -> ResetDone | ResetRefused:
        """Clear the latch at an operator's request, judged on the current ``view`` and ``alarms``; nothing moves."""
        self._latch.update((*alarms, *self._violations(view)))
        return self._latch.reset(
            token,
            at_rest=all(self._at_rest(arm.state.value.twist) for arm in view.arms.values()),
            commanded=any(arm.command is not None and np.any(arm.command.twist) for arm in view.arms.values()),
        )

    def _violations(self, view: CellView) -> tuple[Violation, ...]:
        if (first := _checked(self._finite, view)) is not None:
            return (first,)
        found = [violation for rule in self._rules if (violation := _checked(rule, view)) is not None]
        return self._escalated(found, view.now_ns)

    def _escalated(self, found: Sequence[Violation], now_ns: int) -> tuple[Violation, ...]:
        """Return ``found`` with a trip in place of each LIMIT violation that has lasted too long."""
        limiting = {(v.interlock, v.subject) for v in found if v.severity is Severity.LIMIT and v.escalates}
        self._limited_since_ns = {key: self._limited_since_ns.get(key, now_ns) for key in limiting}
        lasting = {key for key, since_ns in self._limited_since_ns.items() if now_ns - since_ns > LIMIT_FOR_NS}
        return tuple(
            replace(v, severity=Severity.TRIP, reason=f"{v.reason}, limiting for over {1e-6 * LIMIT_FOR_NS:g} ms")
            if (v.interlock, v.subject) in lasting
            else v
            for v in found
        )

    def _at_rest(self, twist: np.ndarray) -> bool:
        linear, angular = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
        return bool(linear <= self._rest_m_s and angular <= self._rest_rad_s)


def _checked(interlock: Interlock, view: CellView) -> Violation | None:
    try:
        return interlock.check(view)
    except Exception as error:
        reason = f"the interlock could not be evaluated: {error!r}"
        return Violation(interlock.name, Severity.FAULT, "cell", reason, view.now_ns)
