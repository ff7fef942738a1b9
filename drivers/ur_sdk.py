"""Calls into ur-rtde 1.6.5 that may hang, kept from holding up the caller and the rest of the process.

Its methods release the interpreter's lock, so ``bounded`` can leave a hanging one behind. Its constructors and
destructors do not release it: call a constructor only right after the controller has answered, and never let a
destructor run, because it sleeps 0.5 s during which no thread of the process would move (``retire``).
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from drivers.errors import DeviceError, DeviceGone, TransportTimeout

T = TypeVar("T")

_DASHBOARD_S = 1.0
_GOODBYE_S = 0.1
_POLL_S = 0.001


def bounded(device: str, what: str, timeout_s: float, call: Callable[[], T]) -> T:
    """Result of a vendor call that may hang: it is left behind in its thread after ``timeout_s``.

    Raises:
        TransportTimeout: it had not returned.
        DeviceGone: it raised one of the vendor's errors.
    """
    results: list[T] = []
    errors: list[Exception] = []

    def work() -> None:
        try:
            results.append(call())
        except Exception as error:
            errors.append(error)

    # A daemon, because a call into a frozen controller must not keep the process from ending.
    thread = threading.Thread(target=work, name=f"{device} {what}", daemon=True)
    thread.start()
    thread.join(timeout_s)
    if errors:
        if isinstance(errors[0], DeviceError):
            raise errors[0]
        raise DeviceGone(device, f"{what}: {errors[0]}") from errors[0]
    if not results:
        raise TransportTimeout(device, what, timeout_s)
    return results[0]


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
