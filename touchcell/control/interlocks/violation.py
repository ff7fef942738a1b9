"""What an interlock says when its rule is broken."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from touchcell.control.interlocks.errors import SafetyTrip


class Severity(IntEnum):
    """How much a violation asks for, in rising order."""

    LIMIT = 1
    """Motion goes on, slower; a violation that lasts becomes a trip. It is reported."""
    TRIP = 2
    """Controlled stop, latched; a person resets it once the cause has gone."""
    FAULT = 3
    """A device or its data can no longer be trusted: the same, and the device needs recovery."""


@dataclass(frozen=True, slots=True)
class Violation:
    """One broken rule.

    Attributes:
        interlock: the interlock's name.
        severity: what it asks for.
        subject: role of the arm or the sensor it is about.
        reason: what is wrong, in words.
        t_ns: time of the control cycle.
        value: what was found, in ``unit``; None where there is no number for it.
        limit: what is allowed, in ``unit``; None likewise.
        unit: of both.
        frame_seq: number of the tactile frame that showed it, where it was one.
        may_last: whether motion may stay slowed for as long as it likes; else a limit that lasts becomes a trip.
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
    may_last: bool = False

    def as_error(self) -> SafetyTrip:
        """The same as an exception, for those who must not go on."""
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
