"""What can go wrong in control, as types with attributes."""

from __future__ import annotations

from typing import Any

from touchcell.geometry.errors import TouchcellError


class ControlError(TouchcellError, ValueError):
    """A controller was given something that it must not work with; nothing was changed in it.

    Attributes:
        argument: name of the offending argument.
        value: what it was.
    """

    def __init__(self, argument: str, reason: str, value: Any, *, hint: str = "") -> None:
        super().__init__(f"{argument} {reason}", hint=hint)
        self.argument = argument
        self.value = value


class SafetyTrip(TouchcellError):
    """An interlock has latched; nothing moves until a person has reset it.

    Attributes:
        interlock: name of the interlock that was violated first.
        subject: role of the arm or the sensor it was about.
        value: what was found, in ``unit``; None where there is no number for it.
        limit: what is allowed, in ``unit``; None likewise.
        unit: of both.
        t_ns: time of the control cycle.
        frame_seq: number of the tactile frame that showed it, where it was one.
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
