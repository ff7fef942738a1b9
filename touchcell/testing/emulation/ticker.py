"""A periodic timer for emulators that must keep a device's rate: Linux timerfd in the asyncio loop.

asyncio's own timers are rounded to a millisecond, which is the period of some robots.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

from touchcell.drivers.core.paced_clock import emulated_clock, emulated_pace

_MADE_UP_FOR = 5
_COASTED_THROUGH = 50


@dataclass(frozen=True, slots=True)
class Tick:
    """One tick of a ``Ticker``.

    Attributes:
        late: whether it came late.
        coasted: number of periods that passed unnoticed since the one before, for which there will be no tick.
    """

    late: bool
    coasted: int = 0


def following_tick(due_ns: int, now_ns: int, period_ns: int, *, waits: bool = False) -> tuple[int, int, Tick]:
    """Plan the tick after the one that was due at ``due_ns`` and comes now.

    With ``waits`` none is coasted through: the device's clock waits for a busy machine.

    Returns:
        when the next is due, in how many nanoseconds to wake up for it, and what this one is.
    """
    late_ns = now_ns - due_ns
    behind = late_ns // period_ns
    coasted = behind if _MADE_UP_FOR < behind <= _COASTED_THROUGH and not waits else 0
    due_ns = now_ns if behind > (_MADE_UP_FOR if waits else _COASTED_THROUGH) else due_ns + coasted * period_ns
    next_due_ns = due_ns + period_ns
    return next_due_ns, max(next_due_ns - now_ns, 3 * period_ns // 4), Tick(late_ns > period_ns // 4, coasted)


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", _Timespec), ("it_value", _Timespec))


class Ticker:
    """Call ``on_tick(tick)`` from the running loop each period of the emulated world's time.

    Two ticks are never closer than three quarters of a period. Up to five late ticks are made up for at four thirds of
    the rate. Up to fifty are coasted through at once, as a device's clock does not wait for a busy machine. More are
    skipped: the process was suspended.

    Args:
        period_ns: below one second.
        on_tick: called in the loop's thread.
        waits: late ticks are never coasted through, so that a busy machine slows the device's clock.
    """

    def __init__(self, period_ns: int, on_tick: Callable[[Tick], None], *, waits: bool = False) -> None:
        self._waits = waits
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
        self._due_ns, in_ns, tick = following_tick(
            self._due_ns, self._clock.now_ns(), self._period_ns, waits=self._waits
        )
        self._arm(in_ns)
        self._on_tick(tick)
