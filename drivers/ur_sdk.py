"""What touchcell calls in ur-rtde 1.6.5 besides its state stream, and how it is kept from doing harm.

Its constructors and destructors hold the interpreter's lock: call a constructor only right after the controller has
answered, and never let a destructor run, because it sleeps 0.5 s during which no thread of the process would move.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from drivers.errors import DeviceGone

_DASHBOARD_S = 1.0
_GOODBYE_S = 0.1
_POLL_S = 0.001


@contextmanager
def dashboard(device: str, host: str) -> Iterator[Any]:
    """ur-rtde's dashboard client, connected. Raises DeviceGone when the dashboard does not answer."""
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
    """Send ur-rtde's control program to a controller on which none is playing, and let go of it.

    The command register is cleared first, for it outlives programs and clients: a program that starts while it still
    says speedL would move at once. ur-rtde's control interface does that on construction. It serves for nothing else,
    since it reconnects by itself when the link drops, racing with its own threads: that repeats commands, takes the
    registers from others, and was seen to crash the process.

    Raises:
        DeviceGone: the controller did not take it, or another client owns the registers.
    """
    from rtde_control import RTDEControlInterface

    try:
        control = RTDEControlInterface(host, flags=RTDEControlInterface.FLAG_NO_WAIT)
    except RuntimeError as error:
        raise DeviceGone(device, f"RTDE control of {host}: {error}") from error
    try:
        control.reuploadScript()
    except RuntimeError as error:
        raise DeviceGone(device, f"upload to {host}: {error}") from error
    finally:
        retire(device, control)


def retire(device: str, interface: Any) -> None:
    """Disconnect an RTDE interface and never destroy it.

    Disconnecting sleeps 0.5 s after the socket has been closed, which nobody needs to wait for. The reference that is
    kept costs some kilobytes per activation.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(interface))
    goodbye = threading.Thread(target=interface.disconnect, name=f"{device} goodbye")
    goodbye.start()
    deadline_s = time.monotonic() + _GOODBYE_S
    while interface.isConnected() and time.monotonic() < deadline_s:
        goodbye.join(_POLL_S)
