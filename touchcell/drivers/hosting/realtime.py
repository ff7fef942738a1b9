"""Request real-time scheduling and locked memory from the kernel, and report what was granted."""

from __future__ import annotations

import ctypes
import logging
import os
import resource
import signal
from typing import Any, Final

_logger = logging.getLogger(__name__)

PRIORITY: Final = 40
"""Below the kernel's own interrupt threads (50), above all ordinary processes."""

LONGEST_US: Final = 200_000
"""A process that computes this long without a pause falls back to ordinary scheduling, so that others can run."""

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def request_realtime() -> str:
    """Request SCHED_FIFO and mlockall for this process; return a description of what was granted. Never fails."""
    granted = f"{_scheduling()}, {_memory()}"
    _logger.info("%s", granted)
    return granted


def _scheduling() -> str:
    try:
        signal.signal(signal.SIGXCPU, _lower_priority)
        resource.setrlimit(resource.RLIMIT_RTTIME, (LONGEST_US, resource.RLIM_INFINITY))
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return f"ordinary scheduling ({error.strerror})"
    return f"SCHED_FIFO {PRIORITY}"


def _lower_priority(*_: Any) -> None:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _memory() -> str:
    # Under a small limit a lock on future memory would make ordinary allocations fail.
    if os.geteuid() != 0 and resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return "memory not locked (limited by RLIMIT_MEMLOCK)"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        return f"memory not locked ({os.strerror(ctypes.get_errno())})"
    return "memory locked"
