"""A periodic timer for emulators that must keep a device's rate: Linux timerfd in the asyncio loop.

asyncio's own timers are rounded to a millisecond, which is the period of some robots.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
from collections.abc import Callable

_CLOCK_MONOTONIC = 1
_NONBLOCK_CLOEXEC = os.O_NONBLOCK | os.O_CLOEXEC


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", _Timespec), ("it_value", _Timespec))


class Ticker:
    """Calls ``on_tick(n)`` from the running loop each period; n > 1 when the process overslept n - 1 periods.

    Args:
        period_ns: below one second.
        on_tick: called in the loop's thread.
    """

    def __init__(self, period_ns: int, on_tick: Callable[[int], None]) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._on_tick = on_tick
        self._fd: int = libc.timerfd_create(_CLOCK_MONOTONIC, _NONBLOCK_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        period = _Timespec(0, period_ns)
        if libc.timerfd_settime(self._fd, 0, ctypes.byref(_Itimerspec(period, period)), None):
            os.close(self._fd)
            raise OSError(ctypes.get_errno(), "timerfd_settime")
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._expired)

    def close(self) -> None:
        """Stop ticking."""
        self._loop.remove_reader(self._fd)
        os.close(self._fd)

    def _expired(self) -> None:
        try:
            count = int.from_bytes(os.read(self._fd, 8), "little")
        except BlockingIOError:
            return
        self._on_tick(count)
