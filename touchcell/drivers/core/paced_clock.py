"""Time of an emulated cell that runs slower than the machine's, declared by a pace.

Emulators, drivers and the cell share a machine's cores. Where there are too few of them, every age and latency grows,
and a cell trips that would not on its bench. With a pace of 0.25 all clocks of the emulated world run at a quarter of
the machine's: computing costs a quarter of what it did, and everything else is as it was.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

from touchcell.drivers.core.clock import Clock, MonotonicClock, poll_readable

PACE: Final = "TOUCHCELL_EMULATED_PACE"
"""Variable with pace and origin in ns of an emulated world's time, which all of its processes read."""


class PacedClock:
    """CLOCK_MONOTONIC of the machine, slower by a factor from an origin on.

    Args:
        pace: seconds of this clock in each second of the machine, at most 1.
        origin_ns: machine's time at which both show the same.
    """

    def __init__(self, pace: float, origin_ns: int) -> None:
        self.pace = pace
        self._origin_ns = origin_ns

    def now_ns(self) -> int:
        return self._origin_ns + int(self.pace * (time.monotonic_ns() - self._origin_ns))

    def sleep_until_ns(self, t_ns: int) -> None:
        while (remaining_ns := t_ns - self.now_ns()) > 0:
            # A clock that has not reached a whole nanosecond yet is waited for once more.
            time.sleep(max(remaining_ns, 1) * 1e-9 / self.pace)

    def wait_readable(self, fd: int, until_ns: int) -> bool:
        return poll_readable(fd, (until_ns - self.now_ns()) * 1e-9 / self.pace)


_SHARED: Final[ContextVar[Clock]] = ContextVar("clock of an emulated world within this process")


@contextmanager
def share_clock(clock: Clock) -> Iterator[None]:
    """Make ``clock`` the one of the emulated world, for this context and the threads that copy it."""
    token = _SHARED.set(clock)
    try:
        yield
    finally:
        _SHARED.reset(token)


def emulated_clock() -> Clock:
    """Return the clock of the emulated world that this process belongs to: the machine's where none is slower."""
    if (shared := _SHARED.get(None)) is not None:
        return shared
    pace, _, origin_ns = os.environ.get(PACE, "").partition(" ")
    return PacedClock(float(pace), int(origin_ns)) if pace else MonotonicClock()


def emulated_pace() -> float:
    """Return the pace of the emulated world that this process belongs to; 1 where none is slower."""
    clock = emulated_clock()
    return clock.pace if isinstance(clock, PacedClock) else 1.0


def pace_variables(pace: float) -> dict[str, str]:
    """Return the variables with which processes share a time of this pace that begins now; none for a pace of 1."""
    return {} if pace == 1.0 else {PACE: f"{pace!r} {time.monotonic_ns()}"}
