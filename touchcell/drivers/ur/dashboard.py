"""Universal Robots' dashboard server: one line of text in each direction, on a connection for a few questions.

Source: Universal Robots, "Dashboard Server e-Series, port 29999".
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from touchcell.drivers.core.clock import Clock, wait_readable
from touchcell.drivers.core.errors import DeviceGone

PORT = 29999
_TIMEOUT_S = 1.0
_LONGEST_LINE = 4096


class Dashboard:
    """An open connection.

    Args:
        device: name for errors.
        host: address of the controller.
        clock: the host's clock.

    Raises on construction:
        DeviceGone: nothing answers there.
    """

    def __init__(self, device: str, host: str, clock: Clock) -> None:
        self._device = device
        self._host = host
        self._clock = clock
        self._text = b""
        try:
            self._socket = socket.create_connection((host, PORT), _TIMEOUT_S)
        except OSError as error:
            raise self._gone(error) from error
        self._socket.setblocking(False)
        try:
            self._line()
        except BaseException:
            self._socket.close()
            raise

    def ask(self, request: str) -> str:
        """Send a request and return the reply. Raises DeviceGone."""
        try:
            self._socket.sendall(request.encode() + b"\n")
        except OSError as error:
            raise self._gone(error) from error
        return self._line()

    def close(self) -> None:
        """Close the connection; idempotent."""
        self._socket.close()

    def _line(self) -> str:
        deadline_ns = self._clock.now_ns() + round(1e9 * _TIMEOUT_S)
        try:
            while b"\n" not in self._text:
                if not wait_readable(self._clock, self._socket.fileno(), deadline_ns):
                    raise TimeoutError("timed out")
                piece = self._socket.recv(_LONGEST_LINE)
                if not piece or len(self._text) > _LONGEST_LINE:
                    raise OSError("closed by the controller" if not piece else "no end of line")
                self._text += piece
        except OSError as error:
            raise self._gone(error) from error
        line, _, self._text = self._text.partition(b"\n")
        return line.decode(errors="replace").strip()

    def _gone(self, error: OSError) -> DeviceGone:
        return DeviceGone(
            self._device,
            f"dashboard of {self._host}: {error}",
            hint="PolyScope 5 serves it on port 29999; PolyScope X has none, and Settings > Security may close it",
        )


@contextmanager
def dashboard(device: str, host: str, clock: Clock) -> Iterator[Dashboard]:
    """Connect for the duration of a ``with`` block. Raises DeviceGone."""
    client = Dashboard(device, host, clock)
    try:
        yield client
    finally:
        client.close()
