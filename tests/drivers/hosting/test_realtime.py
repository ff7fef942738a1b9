"""Real-time scheduling is requested, and lost by a process that never pauses."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

SPIN = """
import os, time
from touchcell.drivers.hosting.realtime import request_realtime
print(request_realtime().split(" ")[0], os.sched_getscheduler(0) == os.SCHED_FIFO)
deadline = time.monotonic() + 20.0
while os.sched_getscheduler(0) == os.SCHED_FIFO and time.monotonic() < deadline:
    pass
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
"""
REFUSED = """
import errno, os
def refuse(*_):
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
os.sched_setscheduler = refuse
"""


def run_script(script: str) -> list[str]:
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return run.stdout.split()


def test_a_process_that_never_pauses_falls_back_to_ordinary_scheduling() -> None:
    if os.geteuid() != 0:
        pytest.skip("needs the privilege for real-time scheduling")
    lines = run_script(SPIN)
    if lines[0] != "SCHED_FIFO":
        pytest.skip("no real-time scheduling in this container")
    assert lines == ["SCHED_FIFO", "True", "True"]


def test_without_the_privilege_it_continues_and_reports_it() -> None:
    assert run_script(REFUSED + SPIN) == ["ordinary", "False", "True"]
