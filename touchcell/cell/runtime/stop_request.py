"""An operator's wish to end the run, as a signal handler or a key leaves it for the loop."""

from __future__ import annotations


class StopRequest:
    """Set by a signal handler or a key. The first request asks for an orderly end, the second for a stop at once."""

    def __init__(self) -> None:
        self.count = 0

    @property
    def orderly(self) -> bool:
        """Whether the task is to end in its own way, or faster."""
        return self.count > 0

    @property
    def at_once(self) -> bool:
        """Whether the arms are to stop where they are."""
        return self.count > 1

    def ask(self) -> None:
        """Request once more."""
        self.count += 1

    def ask_at_once(self) -> None:
        """Request a stop at once."""
        self.count += 2
