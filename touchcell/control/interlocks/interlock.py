"""What an interlock is: a pure rule over a snapshot of the cell."""

from __future__ import annotations

from typing import Protocol

from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.violation import Severity, Violation


class Interlock(Protocol):
    """A rule. ``check`` is a pure function of the view; what it raises counts as a fault."""

    @property
    def name(self) -> str:
        """Its name in the cell file."""
        ...

    @property
    def severity(self) -> Severity:
        """What a violation asks for."""
        ...

    def check(self, view: CellView) -> Violation | None:
        """The worst violation in ``view``, or None."""
        ...
