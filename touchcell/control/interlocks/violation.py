"""Violations: what an interlock reports, and how severe it is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from touchcell.control.interlocks.errors import SafetyTrip


class Severity(IntEnum):
    """Reaction that a violation requests, in rising order."""

    LIMIT = 1
    """Motion continues at reduced speed, and the violation is reported; one that lasts becomes a trip."""
    TRIP = 2
    """Controlled stop, latched; an operator resets it once the cause has gone."""
    FAULT = 3
    """A device or its data can no longer be trusted: stop as for a trip, and the device needs recovery."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A violated interlock.

    Attributes:
        interlock: the interlock's name.
        severity: the requested reaction.
        subject: role of the arm or sensor concerned.
        reason: description for the operator.
        t_ns: time of the control cycle.
        value: offending value in ``unit``; None where there is no number for it.
        limit: its limit in ``unit``; None likewise.
        unit: of both.
        frame_seq: number of the tactile frame that caused it, where it was one.
        escalates: True if a LIMIT violation that lasts becomes a trip; False if motion may stay slowed indefinitely.
        raised: True if the interlock raised an exception, which is a fault; ``reason`` is its text.
    """

    interlock: str
    severity: Severity
    subject: str
    reason: str
    t_ns: int
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    frame_seq: int | None = None
    escalates: bool = True
    raised: bool = False

    def as_error(self) -> SafetyTrip:
        """Return the same as an exception, for callers that must not continue."""
        return SafetyTrip(
            self.interlock,
            self.subject,
            self.reason,
            value=self.value,
            limit=self.limit,
            unit=self.unit,
            t_ns=self.t_ns,
            frame_seq=self.frame_seq,
            hint="remove the cause, bring the arm to rest, then reset",
        )
