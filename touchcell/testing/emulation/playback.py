"""Recorded answers in their order, for emulators that play a capture back."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TypeVar

Answer = TypeVar("Answer")


class Playback:
    """How far each kind of request has been answered."""

    def __init__(self) -> None:
        self._next: dict[Hashable, int] = {}

    def next_of(self, request: Hashable, answers: Sequence[Answer]) -> Answer:
        """Return the next of the ``answers`` recorded for a request, the last one for ever."""
        at = self._next.get(request, 0)
        self._next[request] = at + 1
        return answers[min(at, len(answers) - 1)]

    def begin_again(self) -> None:
        """Answer every request by its first answer next."""
        self._next.clear()
