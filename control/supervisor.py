"""The supervisor: sees every command before the arms do, and decides whether anything may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control.errors import SafetyTrip
from control.interlocks import Finite, Interlock
from control.latch import Latch, LatchState, ResetDone, ResetRefused
from control.view import CellView
from control.violation import Severity, Violation
from drivers.device import OperatorToken


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the supervisor says to one cycle.

    Attributes:
        allow: whether the commands may be sent. If not, every arm is told to stop.
        violations: what is wrong in this cycle.
        trip: the first cause while the latch is not clear, as an error for whoever has to give up.
    """

    allow: bool
    violations: tuple[Violation, ...]
    trip: SafetyTrip | None


class Supervisor:
    """Applies the interlocks to each cycle and holds the latch.

    That every number is finite is checked before anything else, whatever the configuration: a NaN passes every
    comparison that the others would make. A rule that raises is a fault, not a pass.

    Args:
        interlocks: the configured rules.
        latch: remembers what they find.
        rest_m_s, rest_rad_s: an arm that measures at most these speeds is at rest.
    """

    def __init__(
        self, interlocks: Sequence[Interlock], latch: Latch, *, rest_m_s: float = 1e-3, rest_rad_s: float = 1e-2
    ) -> None:
        self._finite = Finite()
        self._interlocks = tuple(interlocks)
        self._latch = latch
        self._rest_m_s = rest_m_s
        self._rest_rad_s = rest_rad_s

    @property
    def latch(self) -> Latch:
        """The latch, to be read."""
        return self._latch

    def review(self, view: CellView) -> Verdict:
        """Check ``view``, latch what it shows, and say whether its commands may be sent. Never raises."""
        violations = self._violations(view)
        self._latch.update(violations)
        first = self._latch.first_cause
        return Verdict(
            allow=self._latch.state is LatchState.CLEAR,
            violations=violations,
            trip=None if first is None else first.as_error(),
        )

    def reset(self, token: OperatorToken, view: CellView) -> ResetDone | ResetRefused:
        """Clear the latch on a person's request, judged on ``view`` as it is now; nothing moves by it."""
        self._latch.update(self._violations(view))
        return self._latch.reset(
            token,
            at_rest=all(self._at_rest(arm.state.value.twist) for arm in view.arms.values()),
            commanded=any(arm.command is not None and np.any(arm.command.twist) for arm in view.arms.values()),
        )

    def _violations(self, view: CellView) -> tuple[Violation, ...]:
        if (first := _checked(self._finite, view)) is not None:
            return (first,)
        found = (_checked(interlock, view) for interlock in self._interlocks)
        return tuple(violation for violation in found if violation is not None)

    def _at_rest(self, twist: np.ndarray) -> bool:
        linear, angular = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
        return bool(linear <= self._rest_m_s and angular <= self._rest_rad_s)


def _checked(interlock: Interlock, view: CellView) -> Violation | None:
    try:
        return interlock.check(view)
    except Exception as error:
        reason = f"the rule could not be applied: {error!r}"
        return Violation(interlock.name, Severity.FAULT, "cell", reason, view.now_ns)
