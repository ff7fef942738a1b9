"""The watchdog of the run loop: none in one process, a chain of processes in several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self

from touchcell.control.interlocks.violation import Violation

NOTES: Final = "watchdog.json"
"""What the watchdog leaves in the run folder when it has stopped the arms."""


class Watchdog(Protocol):
    """What a run loop notifies and polls in every cycle. As a context manager it lives as long as the cell."""

    @property
    def lost(self) -> bool:
        """Whether one of its processes has gone or fallen silent."""
        ...

    def __enter__(self) -> Self:
        """Start what it needs, before any device is connected."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it, after all devices have been given back."""
        ...

    def self_test(self) -> None:
        """Check that it stops moving arms; called with all devices active. Raises DeviceError if it does not."""
        ...

    def begin(self) -> None:
        """Guard the arms from now on. Raises DeviceFault if that fails."""
        ...

    def beat(self) -> None:
        """The loop lives; called once a cycle."""
        ...

    def alarms(self, now_ns: int) -> Sequence[Violation]:
        """Why it has stopped all arms, if it has."""
        ...

    def end(self) -> None:
        """Guard no longer: the arms stand. ``alarms`` then returns what is still wrong."""
        ...

    def clear(self) -> None:
        """Clear its stop on an operator's reset, with all arms at rest and leased by no task. Raises DeviceError."""
        ...

    def note_to(self, folder: Path) -> None:
        """Leave a note in the run folder when it stops the arms, also if the loop cannot."""
        ...

    def describe(self) -> Sequence[str]:
        """Describe its processes, in lines for people."""
        ...


class NullWatchdog:
    """No watchdog: the arms stop when their last command has expired."""

    lost = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def self_test(self) -> None:
        """Nothing to test."""

    def begin(self) -> None:
        """Nothing is guarded."""

    def beat(self) -> None:
        """No beat is needed."""

    def alarms(self, now_ns: int) -> Sequence[Violation]:
        """None ever."""
        return ()

    def end(self) -> None:
        """Nothing was guarded."""

    def clear(self) -> None:
        """Nothing was stopped."""

    def note_to(self, folder: Path) -> None:
        """No note is written."""

    def describe(self) -> Sequence[str]:
        """Nothing to describe."""
        return ()
