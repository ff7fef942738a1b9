"""A CAN bus without a kernel module: a UNIX SEQPACKET hub, and its python-can interface ``touchcell_hub``.

Every packet is one frame in SocketCAN's layout (``struct can_frame``, 16 bytes, or ``struct canfd_frame``, 72 bytes),
so order and frame boundaries are the kernel's. A hub that closes its end acts as an unplugged adapter. Any python-can
program can use it: ``can.Bus(interface="touchcell_hub", channel="/path/of/the/hub")``.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from touchcell.drivers.core import can_errors
from touchcell.drivers.core.can_packets import pack, unpack
from touchcell.drivers.core.clock import wait_readable
from touchcell.drivers.core.paced_clock import emulated_clock

# What the hub makes the adapter of a client do: refuse sends (count, error number or 0 for none), be down (seconds).
_REFUSE = struct.Struct("=Ii")
_DOWN = struct.Struct("=4xd")
_MOST_FRAMES = 256
_LONGEST_WAIT_NS = 1_000_000_000


class HubBus(can.BusABC):  # type: ignore[misc]
    """python-can interface to a ``Hub``.

    Args:
        channel: path of the hub's socket.
        fd: whether CAN FD frames may be sent.
        can_filters: as in python-can.
        options: ``bitrate`` and the like, which are ignored.
    """

    def __init__(self, channel: str, fd: bool = False, can_filters: Any = None, **options: Any) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(str(channel))
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(f"no hub at {channel}: {error}", error.errno) from error
        self.channel_info = f"touchcell_hub {channel}"
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._bus_state = can.BusState.ACTIVE
        self._clock = emulated_clock()
        self._refused_sends, self._refusal = 0, 0
        self._down_until_ns, self._down_reported = 0, True
        super().__init__(channel=channel, can_filters=can_filters)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame. Raises CanOperationError when the adapter is disconnected or its queue is full."""
        if self._refused_sends:
            self._refused_sends -= 1
            if not self._refusal:
                # As python-can's socketcan interface reports a queue that select() finds full: without an error number.
                raise can.CanOperationError("Transmit buffer full")
            raise can.CanOperationError(f"Failed to transmit: {os.strerror(self._refusal)}", self._refusal)
        if self._clock.now_ns() < self._down_until_ns:
            raise can.CanOperationError(f"Failed to transmit: {os.strerror(errno.ENETDOWN)}", errno.ENETDOWN)
        try:
            self._socket.settimeout(timeout or 0.0)
            self._socket.send(pack(msg))
        except BlockingIOError as error:
            raise can.CanOperationError("transmit queue is full", errno.ENOBUFS) from error
        except OSError as error:
            raise can.CanOperationError(f"adapter is disconnected: {error}", error.errno) from error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame that passes the filters; None after ``timeout`` seconds of the emulated world."""
        now_ns = self._clock.now_ns()
        until_ns = None if timeout is None else now_ns + round(1e9 * timeout)
        while True:
            message, _ = self._recv_internal(None if until_ns is None else (until_ns - now_ns) * 1e-9)
            if message is not None and self._matches_filters(message):
                return message
            now_ns = self._clock.now_ns()
            if until_ns is not None and now_ns >= until_ns:
                return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._down_reported:
            # A raw socket reports once that its interface went down, and then waits.
            self._down_reported = True
            raise can.CanOperationError(f"Failed to receive: {os.strerror(errno.ENETDOWN)}", errno.ENETDOWN)
        until_ns = self._clock.now_ns() + (_LONGEST_WAIT_NS if timeout is None else round(1e9 * timeout))
        if not wait_readable(self._clock, self._socket.fileno(), until_ns):
            return None, False
        try:
            packet = self._socket.recv(128)
        except OSError as error:
            raise can.CanOperationError(f"adapter is disconnected: {error}", error.errno) from error
        if not packet:
            raise can.CanOperationError("adapter is disconnected", errno.ENODEV)
        if len(packet) == _REFUSE.size:
            self._refused_sends, self._refusal = _REFUSE.unpack(packet)
            return None, False
        if len(packet) == _DOWN.size:
            self._down_until_ns = self._clock.now_ns() + round(1e9 * _DOWN.unpack(packet)[0])
            self._down_reported = False
            return None, False
        if self._clock.now_ns() < self._down_until_ns:
            return None, False
        message = unpack(packet, time.time())
        if message.is_error_frame:
            self._note_error(message)
        return message, False

    def _note_error(self, message: can.Message) -> None:
        if message.arbitration_id & can_errors.BUS_OFF:
            self._bus_state = can.BusState.ERROR
        elif can_errors.is_error_passive(message.arbitration_id, bytes(message.data)):
            self._bus_state = can.BusState.PASSIVE
        elif message.arbitration_id & can_errors.RESTARTED:
            self._bus_state = can.BusState.ACTIVE

    @property
    def state(self) -> can.BusState:
        """Controller state from the error frames received."""
        return self._bus_state

    def fileno(self) -> int:
        """Return the file descriptor, for select and for python-can's asyncio notifier."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Disconnect from the bus."""
        super().shutdown()
        self._socket.close()


class Hub:
    """The bus: passes every frame to all other clients and to the emulated nodes.

    Args:
        path: path of its socket.
        on_frame: called with every frame from a client.
    """

    def __init__(self, path: Path, on_frame: Callable[[can.Message], None]) -> None:
        self._path = path
        self._on_frame = on_frame
        self._listener: socket.socket | None = None
        self._clients: list[socket.socket] = []

    @property
    def client_count(self) -> int:
        """Number of connected programs."""
        return len(self._clients)

    def open(self) -> None:
        """Listen; call in the event loop's thread."""
        self._path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.setblocking(False)
        self._listener.bind(str(self._path))
        self._listener.listen()
        asyncio.get_running_loop().add_reader(self._listener, self._accept)

    def close(self) -> None:
        """Unplug every client and stop listening."""
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None
        for client in list(self._clients):
            self._leave(client)
        self._path.unlink(missing_ok=True)

    def send(self, message: can.Message, *, but: socket.socket | None = None) -> None:
        """Send a frame to every client; one whose queue is full loses it, as on a real adapter."""
        packet = pack(message)
        for client in list(self._clients):
            if client is but:
                continue
            try:
                client.send(packet)
            except BlockingIOError:
                continue
            except OSError:
                self._leave(client)

    def fill_transmit_queues(self, sends: int, code: int = 0) -> None:
        """Make the adapter of every client refuse that many frames, as if nothing drained its transmit queue.

        Args:
            sends: number of frames.
            code: error number of the refusal; 0 for one without.
        """
        self._command(_REFUSE.pack(sends, code))

    def take_down(self, seconds: float) -> None:
        """Take the interface of every client down for that long, and up again, as ``ip link`` does."""
        self._command(_DOWN.pack(seconds))

    def _command(self, packet: bytes) -> None:
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.send(packet)

    def drain(self) -> None:
        """Read pending frames of clients before the simulated time advances."""
        for client in list(self._clients):
            self._read(client)

    def _accept(self) -> None:
        assert self._listener is not None
        client, _ = self._listener.accept()
        client.setblocking(False)
        self._clients.append(client)
        asyncio.get_running_loop().add_reader(client, self._read, client)

    def _read(self, client: socket.socket) -> None:
        # Bounded: a client that sends faster than a busy machine reads must not stop everything else.
        for _ in range(_MOST_FRAMES):
            if client not in self._clients:
                return
            try:
                packet = client.recv(128)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._leave(client)
                return
            with contextlib.suppress(ValueError):
                message = unpack(packet)
                self.send(message, but=client)
                self._on_frame(message)

    def _leave(self, client: socket.socket) -> None:
        if client in self._clients:
            self._clients.remove(client)
            asyncio.get_running_loop().remove_reader(client)
            client.close()
