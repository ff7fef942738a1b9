"""Time of the last sent command, from the run loop's messages to its black box."""

from __future__ import annotations

from collections.abc import Sequence

from touchcell.cell.recording.message_types import Encoded
from touchcell.cell.runtime.run_record import Box


class SentCommands:
    """A black box that records when the last command was sent.

    Args:
        box: receives all messages too.
    """

    def __init__(self, box: Box | None = None) -> None:
        self._box = box
        self._last_ns: int | None = None

    def add(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        """Take in messages."""
        for topic, t_ns, _ in messages:
            if topic.endswith("/command"):
                self._last_ns = t_ns
        if self._box is not None:
            self._box.add(messages)

    def since(self, t_ns: int) -> bool:
        """Return True if a command was sent at ``t_ns`` or later."""
        return self._last_ns is not None and self._last_ns >= t_ns
