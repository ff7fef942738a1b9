"""Clocks, injected everywhere, so that a simulated cell is deterministic and runs faster than real time."""

from __future__ import annotations

import select
import time
from typing import Protocol, runtime_checkable


class Clock(Protocol):
    """Monotonic clock in integer nanoseconds."""

    def now_ns(self) -> int:
        """Return nanoseconds since an arbitrary epoch; never decreases."""
        ...

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until ``t_ns``; return at once if that has passed."""
        ...


@runtime_checkable
class FileClock(Protocol):
    """Clock on whose time files are waited for, where that is not the machine's."""

    def wait_readable(self, fd: int, until_ns: int) -> bool:
        """Wait until ``fd`` can be read or ``until_ns``; return whether it can."""
        ...


def poll_readable(fd: int, timeout_s: float) -> bool:
    """Wait until ``fd`` can be read or has failed, for ``timeout_s`` of the machine's time; return whether it has."""
    # Not select(), which fails for file descriptors beyond 1023.
    poller = select.poll()
    poller.register(fd, select.POLLIN)
    return bool(poller.poll(1e3 * max(timeout_s, 0.0)))


def wait_readable(clock: Clock, fd: int, until_ns: int) -> bool:
    """Wait until ``fd`` can be read or it is ``until_ns`` on ``clock``; return whether it can."""
    if isinstance(clock, FileClock):
        return clock.wait_readable(fd, until_ns)
    return poll_readable(fd, (until_ns - clock.now_ns()) * 1e-9)


class MonotonicClock:
    """CLOCK_MONOTONIC of the machine, which V4L2 and the vendors' drivers also use for timestamps."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        # Sleeping in absolute time: an overrun of one period does not shift the next.
        while (remaining_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(remaining_ns * 1e-9)


class VirtualClock:
    """Simulated clock that advances only when code sleeps. Single-threaded."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self._now_ns = max(self._now_ns, t_ns)

    def advance_s(self, seconds: float) -> None:
        """Advance by ``seconds`` at once."""
        self._now_ns += round(seconds * 1e9)
