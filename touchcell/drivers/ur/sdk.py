"""Calls to ur-rtde 1.6.5 besides its state stream, with its blocking contained.

Its constructors and destructors hold the GIL: call a constructor only right after the controller has replied, and let a
destructor run only when no arm moves, because it sleeps 0.5 s.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from touchcell.drivers.core.errors import DeviceGone

_DASHBOARD_S = 1.0
_UPLOAD_S = 10.0


@contextmanager
def dashboard(device: str, host: str) -> Iterator[Any]:
    """Connect ur-rtde's dashboard client. Raises DeviceGone when the dashboard does not reply."""
    from dashboard_client import DashboardClient

    client = DashboardClient(host)
    try:
        client.connect(round(_DASHBOARD_S * 1e3))
        yield client
    except RuntimeError as error:
        raise DeviceGone(device, f"dashboard of {host}: {error}") from error
    finally:
        client.disconnect()


def upload_control_program(device: str, host: str) -> None:
    """Upload ur-rtde's control program to a controller with none playing, through ``touchcell.drivers.ur.upload``.

    Raises:
        DeviceGone: the controller did not accept it, or another client owns the registers.
    """
    command = [sys.executable, "-m", "touchcell.drivers.ur.upload", host]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_UPLOAD_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise DeviceGone(device, f"upload to {host}: not finished within {_UPLOAD_S:g} s") from None
    if done.returncode != 0:
        reason = done.stderr.strip().rpartition("\n")[2] or f"ended with {done.returncode}"
        raise DeviceGone(device, f"upload to {host}: {reason}")
