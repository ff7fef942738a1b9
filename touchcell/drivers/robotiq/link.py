"""Requests to a gripper and their replies, over a serial line (Modbus RTU) or a network (Modbus TCP).

One request is under way at a time. A TCP reply names its request; on a serial line a reply that comes too late is
discarded with what else has arrived before the next request.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any, Protocol

from touchcell.drivers.core.clock import Clock, wait_readable
from touchcell.drivers.core.errors import CodecError, ConnectError, CorruptMessage, DeviceGone, TransportTimeout
from touchcell.drivers.robotiq import modbus
from touchcell.drivers.robotiq.modbus import Message

_READ_SIZE = 512


class ModbusLink(Protocol):
    """A way to the gripper."""

    def open(self) -> None:
        """Open it. Raises ConnectError."""
        ...

    def close(self) -> None:
        """Close it; does nothing if it is not open."""
        ...

    def ask(self, request: Message, timeout_s: float) -> Message:
        """Return the reply. Raises TransportTimeout, CorruptMessage, or DeviceGone."""
        ...


class SerialLink:
    """Modbus RTU.

    Args:
        device: name for errors.
        connect: opens the pyserial port, non-blocking.
        clock: injected time.
    """

    def __init__(self, device: str, connect: Callable[[], Any], clock: Clock) -> None:
        self._device = device
        self._connect = connect
        self._clock = clock
        self._port: Any = None

    def open(self) -> None:
        """Open the port. Raises ConnectError."""
        self._port = self._connect()

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def ask(self, request: Message, timeout_s: float) -> Message:
        """Return the reply. Raises TransportTimeout, CorruptMessage, or DeviceGone."""
        deadline_ns = self._clock.now_ns() + round(1e9 * timeout_s)
        try:
            while self._port.read(_READ_SIZE):
                continue
            self._port.write(modbus.encode_rtu(request))
            frame = b""
            while (length := modbus.rtu_length(frame, is_request=False)) is None or len(frame) < length:
                if not wait_readable(self._clock, self._port.fileno(), deadline_ns):
                    raise TransportTimeout(self._device, f"reply to function {request.function}", timeout_s)
                frame += self._port.read(_READ_SIZE)
            reply = modbus.decode_rtu(frame[:length])
        except CodecError as error:
            raise CorruptMessage(self._device, str(error)) from None
        except OSError as error:
            raise DeviceGone(self._device, f"lost the port: {error}") from None
        if reply.unit != request.unit or reply.function & ~modbus.ERROR_BIT != request.function:
            raise CorruptMessage(self._device, f"a reply of unit {reply.unit} to function {reply.function}")
        return reply


class TcpLink:
    """Modbus TCP.

    Args:
        device: name for errors.
        host, port: address of the gripper or its gateway.
        timeout_s: timeout of the connection.
        clock: injected time.
    """

    def __init__(self, device: str, host: str, port: int, timeout_s: float, clock: Clock) -> None:
        self._device = device
        self._address = (host, port)
        self._timeout_s = timeout_s
        self._clock = clock
        self._socket: socket.socket | None = None
        self._stream = b""
        self._transaction = 0

    def open(self) -> None:
        """Connect. Raises ConnectError."""
        try:
            self._socket = socket.create_connection(self._address, self._timeout_s)
        except OSError as error:
            raise ConnectError(
                self._device,
                f"no Modbus server at {self._address[0]}:{self._address[1]}",
                [error],
                hint="is the gripper's gateway powered and reachable?",
            ) from None
        # Otherwise a request that follows a lost reply waits for the acknowledgement of the one before.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._stream = b""

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ask(self, request: Message, timeout_s: float) -> Message:
        """Return the reply. Raises TransportTimeout, CorruptMessage, or DeviceGone."""
        used = self._socket
        if used is None:
            raise DeviceGone(self._device, "the connection is closed")
        self._transaction = (self._transaction + 1) & 0xFFFF
        deadline_ns = self._clock.now_ns() + round(1e9 * timeout_s)
        try:
            used.sendall(modbus.encode_tcp(request, self._transaction))
            while True:
                found, self._stream = modbus.split_tcp(self._stream)
                for transaction, reply in found:
                    if transaction == self._transaction:
                        return reply
                if not wait_readable(self._clock, used.fileno(), deadline_ns):
                    raise TransportTimeout(self._device, f"reply to function {request.function}", timeout_s)
                if not (piece := used.recv(_READ_SIZE)):
                    raise ConnectionError("closed by the gripper")
                self._stream += piece
        except CodecError as error:
            self._stream = b""
            raise CorruptMessage(self._device, str(error)) from None
        except OSError as error:
            raise DeviceGone(self._device, f"lost the connection: {error}") from None
