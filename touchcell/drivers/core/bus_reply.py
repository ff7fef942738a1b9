"""Replies and message statistics of motor buses."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Generic, TypeVar

StateT = TypeVar("StateT")


@dataclass(frozen=True, slots=True)
class Reply(Generic[StateT]):
    """State of a motor, stamped when it was requested (its age is at most the time since)."""

    state: StateT
    t_ns: int


@dataclass(slots=True)
class BusCounters:
    """Message statistics since the bus was opened."""

    sent: int = 0
    answered: int = 0
    missed: int = 0
    corrupt: int = 0
    unexpected: int = 0
    not_sent: int = 0

    def as_dict(self) -> dict[str, int]:
        """Return the counters by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
