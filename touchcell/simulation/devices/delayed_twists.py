"""Twists on their way from a simulated driver to its arm."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class DelayedTwist:
    """A twist on its way.

    Attributes:
        due_ns: when it arrives.
        twist_base: (6,) along base axes.
        expires_ns: end of its time-to-live.
    """

    due_ns: int
    twist_base: Array
    expires_ns: int

    def postponed(self, by_ns: int) -> DelayedTwist:
        """Return it as it would be ``by_ns`` later."""
        return replace(self, due_ns=self.due_ns + by_ns, expires_ns=self.expires_ns + by_ns)


class DelayedTwists:
    """Queue of twists on their way, in the order in which they arrive."""

    def __init__(self) -> None:
        self._queue: deque[DelayedTwist] = deque()

    def __bool__(self) -> bool:
        return bool(self._queue)

    def add(self, twist_base: Array, due_ns: int, expires_ns: int) -> None:
        """Send a copy of ``twist_base`` (6,) on its way."""
        self._queue.append(DelayedTwist(due_ns, twist_base.copy(), expires_ns))

    def arrived(self, t_ns: int) -> Iterator[DelayedTwist]:
        """Remove and yield those that have arrived by ``t_ns``."""
        while self._queue and self._queue[0].due_ns <= t_ns:
            yield self._queue.popleft()

    def clear(self) -> None:
        """Drop all."""
        self._queue.clear()

    def snapshot(self) -> Callable[[int], None]:
        """Return what puts the queue back to how it is now, later by a number of nanoseconds."""
        kept = tuple(self._queue)

        def restore(later_ns: int) -> None:
            self._queue = deque(late.postponed(later_ns) for late in kept)

        return restore
