"""Processes that run beside a run: how they are ended."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from contextlib import suppress


def end_all(processes: Sequence[subprocess.Popen[bytes]], wait_s: float) -> None:
    """Ask all processes to end, then kill each that has not ended ``wait_s`` later."""
    for process in processes:
        process.terminate()
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(wait_s)
        if process.poll() is None:
            process.kill()
            process.wait()
