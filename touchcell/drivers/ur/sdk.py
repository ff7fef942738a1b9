"""The only use of ur-rtde 1.6.5: its control program is uploaded, by a process of its own.

Its constructors and destructors hold the interpreter's lock, up to half a second in a destructor, which would starve
every other arm of this process.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

from touchcell.drivers.core.errors import DeviceGone

_UPLOAD_S = 10.0

Upload = Callable[[str, str], None]
"""Function of device and host that uploads the control program, as ``upload_control_program`` does."""


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
