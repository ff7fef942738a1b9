"""Who looks after the run loop from outside it: nobody in one process, the watchdog chain in several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self

from touchcell.control.interlocks.violation import Violation

NOTES: Final = "watchdog.json"
"""What the watchdog leaves in the run folder when it has stopped the arms."""


class Watchdog(Protocol):
    """What a run loop tells and asks in every cycle. As a context manager it lives as long as the cell."""

    def __enter__(self) -> Self:
        """Start what it needs, before any device is connected."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it, after all devices have been given back."""
        ...

    def self_test(self) -> None:
        """Show that it stops moving arms; called with all devices active. Raises DeviceError if it does not."""
        ...

    def begin(self) -> None:
        """Guard the arms from now on. Raises DeviceFault if nobody does."""
        ...

    def beat(self) -> None:
        """The loop goes on; called once a cycle."""
        ...

    def alarms(self, now_ns: int) -> Sequence[Violation]:
        """Why it has stopped all arms, if it has."""
        ...

    def end(self) -> None:
        """The arms stand, or have been told all that can be told. From here on ``alarms`` tells what is still wrong."""
        ...

    def clear(self) -> None:
        """Forget why it has stopped the arms, on a person's reset: they stand and are nobody's. Raises DeviceError."""
        ...

    def note_to(self, folder: Path) -> None:
        """Leave a note in the run folder when it stops the arms, also if the loop cannot."""
        ...

    def describe(self) -> Sequence[str]:
        """What there is, in lines for people."""
        ...


class NullWatchdog:
    """Nobody: the arms stop when their last command has expired."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def self_test(self) -> None:
        """Nothing to prove."""

    def begin(self) -> None:
        """Nobody watches."""

    def beat(self) -> None:
        """Nobody listens."""

    def alarms(self, now_ns: int) -> Sequence[Violation]:
        """None ever."""
        return ()

    def end(self) -> None:
        """Nobody watched."""

    def clear(self) -> None:
        """Nobody has stopped anything."""

    def note_to(self, folder: Path) -> None:
        """Nobody writes."""

    def describe(self) -> Sequence[str]:
        """Nothing to say."""
        return ()
