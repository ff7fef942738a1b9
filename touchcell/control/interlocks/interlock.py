"""Base protocol of the interlocks: a pure rule over a snapshot of the cell."""

from __future__ import annotations

from typing import Protocol

from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.violation import Severity, Violation


class Interlock(Protocol):
    """A stateless interlock. ``check`` is a pure function of the view; an exception in it counts as a fault."""

    @property
    def name(self) -> str:
        """Its name in the cell file."""
        ...

    @property
    def severity(self) -> Severity:
        """Severity of its violations."""
        ...

    def check(self, view: CellView) -> Violation | None:
        """Return the worst violation in ``view``, or None."""
        ...
