"""The latch: a trip persists until an operator resets it, and a reset never moves anything.

    CLEAR -trip-> TRIPPED -fault-> FAULTED      TRIPPED | FAULTED <-> CAUSE_GONE -reset (at rest, idle)-> CLEAR

Manual reset after IEC 60204-1 (9.2) and ISO 13849-1 (5.2.2): deliberate, refused while the cause is present, and not
itself a start. It is not safety-rated: the hard-wired emergency stop and the arm's own controller are the protection.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.device import OperatorToken

_logger = logging.getLogger(__name__)


class LatchState(Enum):
    """State of the latch. Only CLEAR allows motion."""

    CLEAR = "clear"
    TRIPPED = "tripped"
    FAULTED = "faulted"
    CAUSE_GONE = "cause gone"
    """Still latched: an operator may reset it now."""


class Refusal(Enum):
    """Reason why a reset was refused."""

    NOT_LATCHED = "nothing is latched"
    OLD_TOKEN = "the token was made before the latest violation or has been used"
    CAUSE_PRESENT = "a cause is still present"
    NOT_AT_REST = "the arm is not at rest"
    MOTION_COMMANDED = "a motion is still commanded"


@dataclass(frozen=True, slots=True)
class ResetDone:
    """The latch is clear. Nothing moves until a start is commanded.

    Attributes:
        operator: name of the operator who requested the reset.
        causes: violations that had latched, the first cause first.
    """

    operator: str
    causes: tuple[Violation, ...]


@dataclass(frozen=True, slots=True)
class ResetRefused:
    """The reset was refused; the latch is unchanged.

    Attributes:
        reason: the first that applies, in the order of ``Refusal``.
    """

    reason: Refusal


def unlogged_latch() -> Latch:
    """Return a latch for rules that are only tried: what it latches is no event."""
    logger = logging.Logger("tried rules")
    logger.disabled = True
    return Latch(logger)


class Latch:
    """Latch for violations. Not thread-safe.

    Args:
        logger: of causes and resets.
    """

    def __init__(self, logger: logging.Logger = _logger) -> None:
        self._logger = logger
        self._state = LatchState.CLEAR
        self._causes: dict[tuple[str, str], Violation] = {}
        self._present = False
        self._latest_ns = 0
        self._used: OperatorToken | None = None

    @property
    def state(self) -> LatchState:
        """Current state."""
        gone = self._state is not LatchState.CLEAR and not self._present
        return LatchState.CAUSE_GONE if gone else self._state

    @property
    def faulted(self) -> bool:
        """True if any of the causes is a fault, after which a device needs recovery."""
        return self._state is LatchState.FAULTED

    @property
    def first_cause(self) -> Violation | None:
        """The violation that latched it, or None while it is clear."""
        return next(iter(self._causes.values()), None)

    @property
    def causes(self) -> tuple[Violation, ...]:
        """The first cause, then the first violation of every other interlock and subject since, in order of time."""
        return tuple(self._causes.values())

    def update(self, violations: Sequence[Violation]) -> None:
        """Apply one cycle's violations; an empty sequence means that no cause is present any more."""
        latching = [violation for violation in violations if violation.severity is not Severity.LIMIT]
        self._present = bool(latching)
        for violation in latching:
            key = (violation.interlock, violation.subject)
            if key not in self._causes:
                self._causes[key] = violation
                kind = violation.severity.name.lower()
                self._logger.warning("%s: %s: %s: %s", kind, violation.interlock, violation.subject, violation.reason)
            self._latest_ns = max(self._latest_ns, violation.t_ns)
            if violation.severity is Severity.FAULT:
                self._state = LatchState.FAULTED
            elif self._state is LatchState.CLEAR:
                self._state = LatchState.TRIPPED

    def reset(self, token: OperatorToken, *, at_rest: bool, commanded: bool) -> ResetDone | ResetRefused:
        """Clear the latch if all conditions for a reset are met.

        Args:
            token: made by an operator after the latest violation. Each works once, so a held button does nothing.
            at_rest: True if every arm is at rest.
            commanded: True if a motion is still commanded.
        """
        refusals = {
            Refusal.NOT_LATCHED: self._state is LatchState.CLEAR,
            Refusal.OLD_TOKEN: token.t_ns < self._latest_ns or token == self._used,
            Refusal.CAUSE_PRESENT: self._present,
            Refusal.NOT_AT_REST: not at_rest,
            Refusal.MOTION_COMMANDED: commanded,
        }
        for reason, applies in refusals.items():
            if applies:
                return ResetRefused(reason)
        done = ResetDone(token.operator, self.causes)
        self._logger.info("reset by %s", token.operator)
        self._state = LatchState.CLEAR
        self._causes.clear()
        self._used = token
        return done
