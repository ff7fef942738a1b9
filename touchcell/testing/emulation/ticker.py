"""A periodic timer for emulators that must keep a device's rate: Linux timerfd in the asyncio loop.

asyncio's own timers are rounded to a millisecond, which is the period of some robots.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import time
from collections.abc import Callable

from touchcell.drivers.core.paced_clock import emulated_clock, emulated_pace

_MADE_UP_FOR = 50


def following_tick(due_ns: int, now_ns: int, period_ns: int) -> tuple[int, int, bool]:
    """Plan the tick after the one that was due at ``due_ns`` and comes now.

    Returns:
        when the next is due, in how many nanoseconds to wake up for it, and whether this one was late.
    """
    late_ns = now_ns - due_ns
    if late_ns > _MADE_UP_FOR * period_ns:
        due_ns = now_ns
    next_due_ns = due_ns + period_ns
    return next_due_ns, max(next_due_ns - now_ns, 3 * period_ns // 4), late_ns > period_ns // 4


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", _Timespec), ("it_value", _Timespec))


class Ticker:
    """Call ``on_tick(late)`` from the running loop each period.

    Two ticks are never closer than three quarters of a period. Late ticks are made up for at four thirds of the rate,
    unless there are more than fifty of them: then the missed ones are skipped. Periods are in the emulated world's time.

    Args:
        period_ns: below one second.
        on_tick: called in the loop's thread with whether this tick was late.
    """

    def __init__(self, period_ns: int, on_tick: Callable[[bool], None]) -> None:
        self._period_ns = period_ns
        self._on_tick = on_tick
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._fd: int = self._libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        self._clock, self._pace = emulated_clock(), emulated_pace()
        self._due_ns = self._clock.now_ns() + period_ns
        self._arm(period_ns)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._expired)

    def close(self) -> None:
        """Stop ticking."""
        self._loop.remove_reader(self._fd)
        os.close(self._fd)

    def _arm(self, in_ns: int) -> None:
        once = _Itimerspec(_Timespec(0, 0), _Timespec(*divmod(round(in_ns / self._pace), 1_000_000_000)))
        if self._libc.timerfd_settime(self._fd, 0, ctypes.byref(once), None):
            raise OSError(ctypes.get_errno(), "timerfd_settime")

    def _expired(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return
        self._due_ns, in_ns, late = following_tick(self._due_ns, self._clock.now_ns(), self._period_ns)
        self._arm(in_ns)
        self._on_tick(late)
