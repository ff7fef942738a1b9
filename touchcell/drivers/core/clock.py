"""Time: injected everywhere, so that a simulated cell is deterministic and runs as fast as it can."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time in integer nanoseconds."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary start; never goes back."""
        ...

    def sleep_until_ns(self, t_ns: int) -> None:
        """Return at ``t_ns`` or at once if it has passed."""
        ...


class MonotonicClock:
    """The machine's CLOCK_MONOTONIC, which V4L2 and the vendors' drivers stamp with too."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        # Sleeping in absolute time: an overrun of one period does not shift the next.
        while (remaining_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(remaining_ns * 1e-9)


class VirtualClock:
    """Time that passes only when somebody sleeps. One thread only."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self._now_ns = max(self._now_ns, t_ns)

    def advance_s(self, seconds: float) -> None:
        """Let ``seconds`` pass at once."""
        self._now_ns += round(seconds * 1e9)
