"""Errors of the interlocks."""

from __future__ import annotations

from touchcell.errors import TouchcellError


class SafetyTrip(TouchcellError):
    """An interlock has latched; nothing moves until a person has reset it.

    Attributes:
        interlock: name of the interlock that was violated first.
        subject: role of the arm or sensor concerned.
        value: offending value in ``unit``; None where there is no number for it.
        limit: its limit in ``unit``; None likewise.
        unit: of both.
        t_ns: time of the control cycle.
        frame_seq: number of the tactile frame that caused it, where it was one.
    """

    def __init__(
        self,
        interlock: str,
        subject: str,
        reason: str,
        *,
        value: float | None,
        limit: float | None,
        unit: str,
        t_ns: int,
        frame_seq: int | None,
        hint: str = "",
    ) -> None:
        super().__init__(f"{interlock}: {subject}: {reason}", hint=hint)
        self.interlock = interlock
        self.subject = subject
        self.reason = reason
        self.value = value
        self.limit = limit
        self.unit = unit
        self.t_ns = t_ns
        self.frame_seq = frame_seq
