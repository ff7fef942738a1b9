"""The client's side of a keeper: starts it, and looks like a python-can bus to the driver."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import select
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from touchcell.drivers.core.can_packets import FRAME_SIZES, LONGEST, pack, unpack
from touchcell.drivers.core.errors import ConnectError
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    import can

_START_S = 15.0
_BYE, _OFFSETS, _FAILED = b"B", b"O", b"E"


class KeeperBus:
    """A bus behind a keeper, with what ``MotorBus`` needs of python-can.

    Args:
        device: name for errors.
        interface, channel: of python-can; one keeper owns each.
        settings: of the driver, as plain data.

    Raises:
        ConnectError: the keeper does not start, or one that is still lowering the arm owns the bus.
    """

    def __init__(self, device: str, interface: str, channel: str, settings: Mapping[str, Any]) -> None:
        path = _socket_path(interface, channel)
        if path.exists() and _is_alive(path):
            raise ConnectError(
                device,
                f"a keeper holds {channel}",
                hint="it lowers the arm of a client that died, and ends when the arm rests: wait, then connect again",
            )
        self._path = path
        self._process = _start(device, settings, path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(str(path))

    @property
    def pid(self) -> int:
        """Process id of the keeper."""
        return self._process.pid

    @property
    def state(self) -> Any:
        """State of the CAN controller as python-can's interfaces report it: the keeper passes its error frames on."""
        import can

        return can.BusState.ACTIVE

    def tell_offsets(self, offsets: Array) -> None:
        """Send the keeper the joints' offsets (n,) rad, turns included, which only a connected client knows."""
        with suppress(OSError):
            self._socket.send(_OFFSETS + json.dumps(offsets.tolist()).encode())

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        """Send a frame. Raises CanOperationError when the keeper is gone or does not read."""
        import can

        try:
            self._socket.settimeout(timeout or 0.0)
            self._socket.send(pack(message))
        except BlockingIOError as error:
            raise can.CanOperationError("the keeper does not read", errno.ENOBUFS) from error
        except OSError as error:
            raise can.CanOperationError(f"the keeper is gone: {error}", errno.ENODEV) from error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None after ``timeout`` s. Raises CanOperationError for a failure of the adapter."""
        import can

        poller = select.poll()
        poller.register(self._socket, select.POLLIN)
        if not poller.poll(None if timeout is None else math.ceil(1e3 * timeout)):
            return None
        try:
            packet = self._socket.recv(LONGEST * 16)
        except OSError as error:
            raise can.CanOperationError(f"the keeper is gone: {error}", errno.ENODEV) from error
        if not packet:
            raise can.CanOperationError("the keeper has ended", errno.ENODEV)
        if packet[:1] == _FAILED and len(packet) not in FRAME_SIZES:
            told = json.loads(packet[1:])
            raise can.CanOperationError(told["text"], told["code"])
        return unpack(packet)

    def shutdown(self) -> None:
        """Leave: a keeper whose motors are disabled ends, any other lowers the arm."""
        with suppress(OSError):
            self._socket.send(_BYE)
        self._socket.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
            # Nothing happened that somebody would have to read of.
            self._path.with_suffix(".log").unlink(missing_ok=True)


def _socket_path(interface: str, channel: str) -> Path:
    name = hashlib.sha256(f"{interface} {channel}".encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    return folder / f"touchcell-keeper-{os.getuid()}-{name}"


def _is_alive(path: Path) -> bool:
    probe = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        probe.connect(str(path))
    except OSError:
        return False
    finally:
        probe.close()
    return True


def _start(device: str, settings: Mapping[str, Any], path: Path) -> subprocess.Popen[bytes]:
    # What it says last must outlive this process.
    log_path = path.with_suffix(".log")
    log = log_path.open("wb")
    process = subprocess.Popen(
        [sys.executable, "-m", "touchcell.drivers.damiao.keeper"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        # A session of its own: neither a signal to the client's group nor its terminal ends it.
        start_new_session=True,
    )
    log.close()
    assert process.stdin is not None
    assert process.stdout is not None
    about = {"socket": str(path), "config": dict(settings)}
    process.stdin.write(json.dumps(about).encode() + b"\n")
    process.stdin.close()
    ready, _, _ = select.select([process.stdout], [], [], _START_S)
    if not ready or process.stdout.readline().strip() != b"ready":
        process.kill()
        reason = log_path.read_text(errors="replace").strip().rpartition("\n")[2]
        raise ConnectError(device, f"the keeper did not start: {reason or 'it does not reply'}")
    process.stdout.close()
    return process
