"""Requests to Feetech servos and their replies, over a half-duplex serial line.

Servos send only replies, so one thread at a time owns the line and no receive thread is needed. A reply carries neither
time nor number. It is stamped with the time of its request, so its age is never understated, and successive requests
for
states ask for blocks of sixteen different lengths in turn: a reply that arrives cycles too late has the wrong length
and is counted as late instead of being mistaken for a fresh one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from touchcell.drivers.core.bus_reply import BusCounters, Reply
from touchcell.drivers.core.clock import Clock, wait_readable
from touchcell.drivers.core.errors import CodecError, ConnectError, CorruptMessage, DeviceGone, TransportTimeout
from touchcell.drivers.feetech import codec
from touchcell.drivers.feetech.codec import Identity, Packet, Register, ServoState

_TRIES = 3
_ANSWER_TIMEOUT_S = 0.1
_QUIET_S = 0.01
_LONGEST_NOISE_S = 0.2
_READ_SIZE = 4096


@dataclass(slots=True)
class Counters(BusCounters):
    """Message statistics, with the replies that arrived cycles too late."""

    late: int = 0


class ServoBus:
    """The servos of one arm on one serial line. Every public method holds the line exclusively.

    Args:
        device: name for errors.
        ids: the servos, in the order of the joints.
        connect: opens the pyserial port, non-blocking.
        clock: injected time.
        echo: whether the adapter echoes transmitted bytes.

    Attributes:
        counters: message statistics.
    """

    def __init__(
        self, device: str, ids: Sequence[int], connect: Callable[[], Any], clock: Clock, *, echo: bool = False
    ) -> None:
        self._device = device
        self._ids = tuple(ids)
        self._connect = connect
        self._clock = clock
        self._echo = echo
        self._port: Any = None
        self._buffer = b""
        self._lock = threading.RLock()
        self._turn = 0
        self._identities: dict[int, Identity] = {}
        self.counters = Counters()

    def open(self) -> None:
        """Open the port and read the identity of every servo; changes no settings.

        Raises:
            ConnectError: no port, or servos that do not reply; ``causes`` names each.
        """
        self._port = self._connect()
        self._buffer = b""
        self._identities = {}
        self.counters = Counters()
        causes: list[Exception] = []
        for servo in self._ids:
            try:
                data = self.read(servo, Register.FIRMWARE, codec.IDENTITY_LENGTH)
                self._identities[servo] = codec.decode_identity(data)
            except (TransportTimeout, CodecError) as error:
                causes.append(error)
        if causes:
            raise ConnectError(
                self._device, "servos are missing", causes, hint="is the arm powered, are ids and baud rate right?"
            )

    def close(self) -> None:
        """Close the line; does nothing if it was never opened."""
        with self._lock:
            if self._port is not None:
                self._port.close()
                self._port = None

    @property
    def firmware(self) -> str:
        """Versions of the servos' firmware, each once."""
        return ", ".join(sorted({identity.firmware for identity in self._identities.values()}))

    def identity(self, servo: int) -> Identity:
        """Return the identity read when the line was opened."""
        return self._identities[servo]

    def read(self, servo: int, register: int, length: int) -> bytes:
        """Read registers of one servo. Raises TransportTimeout, DeviceGone, ConnectError for an unexpected echo."""
        return self._ask(servo, codec.read(servo, register, length), length)

    def write(self, servo: int, register: int, data: bytes) -> None:
        """Write to one servo and verify its registers.

        Raises:
            TransportTimeout: it does not reply.
            CorruptMessage: its registers differ.
            DeviceGone: lost connection to the adapter.
        """
        with self._lock:
            self._ask(servo, codec.write(servo, register, data), 0)
            if (found := self.read(servo, register, len(data))) != data:
                raise CorruptMessage(
                    self._device, f"servo {servo} has {found.hex(' ')} in register {register}, not {data.hex(' ')}"
                )

    def write_goals(self, goals: Mapping[int, tuple[int, int]]) -> None:
        """Send each servo its goal in ticks and its speed in its own unit, without replies."""
        data = {servo: codec.goal(ticks, speed) for servo, (ticks, speed) in goals.items()}
        with self._lock:
            self._send(codec.sync_write(Register.GOAL_POSITION, data))

    def read_states(self, until_ns: int) -> list[Reply[ServoState] | None]:
        """Request the state of all servos; return when all have replied, and at ``until_ns`` at the latest.

        Raises:
            DeviceGone: lost connection to the adapter.
        """
        with self._lock:
            self._turn = (self._turn + 1) % len(codec.STATE_STARTS)
            start = codec.STATE_STARTS[self._turn]
            length = codec.state_length(start)
            self._drain()
            requested_ns = self._clock.now_ns()
            answers: dict[int, Reply[ServoState]] = {}
            if self._send(codec.sync_read(self._ids, start, length)):
                while len(answers) < len(self._ids):
                    packets = self._receive(until_ns, codec.state_length(codec.STATE_STARTS[0]))
                    if packets is None:
                        break
                    for packet in packets:
                        self._take_state(packet, length, requested_ns, answers)
            self.counters.answered += len(answers)
            self.counters.missed += len(self._ids) - len(answers)
            return [answers.get(servo) for servo in self._ids]

    def _take_state(
        self, packet: Packet, length: int, requested_ns: int, answers: dict[int, Reply[ServoState]]
    ) -> None:
        if packet.servo in self._ids and len(packet.data) != length:
            self.counters.late += 1
            return
        if packet.servo not in self._ids or packet.servo in answers:
            self.counters.unexpected += 1
            return
        try:
            answers[packet.servo] = Reply(codec.decode_state(packet.data), requested_ns)
        except CodecError:
            self.counters.corrupt += 1

    def _ask(self, servo: int, request: bytes, length: int) -> bytes:
        with self._lock:
            self._drain()
            for _ in range(_TRIES):
                if not self._send(request):
                    continue
                until_ns = self._clock.now_ns() + round(_ANSWER_TIMEOUT_S * 1e9)
                while (packets := self._receive(until_ns, codec.IDENTITY_LENGTH)) is not None:
                    for packet in packets:
                        if codec.encode(packet) == request:
                            raise ConnectError(
                                self._device,
                                "the adapter echoes transmitted bytes",
                                hint="set echo: true in the cell file",
                            )
                        if packet.servo == servo and len(packet.data) == length:
                            return packet.data
                        self.counters.unexpected += 1
                self._await_quiet()
            raise TransportTimeout(self._device, f"reply of servo {servo}", _ANSWER_TIMEOUT_S)

    def _drain(self) -> None:
        """Discard bytes received since the last awaited reply."""
        found = codec.split(self._buffer + self._read(0.0))
        self.counters.late += len(found.packets)
        self.counters.corrupt += found.damaged + bool(found.rest)
        self._buffer = b""

    def _await_quiet(self) -> None:
        """Wait until the line is quiet, so that the next reply belongs to the next request."""
        deadline_ns = self._clock.now_ns() + round(_LONGEST_NOISE_S * 1e9)
        self._drain()
        while self._clock.now_ns() < deadline_ns and (late := self._read(_QUIET_S)):
            self._buffer = late
            self._drain()

    def _send(self, data: bytes) -> bool:
        """Send; return whether it went out (and came back, if the adapter echoes)."""
        import serial

        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            self.counters.not_sent += 1
            return False
        except (serial.SerialException, OSError) as error:
            raise self._gone(error) from None
        self.counters.sent += 1
        return self._skip_echo(data) if self._echo else True

    def _skip_echo(self, data: bytes) -> bool:
        until_ns = self._clock.now_ns() + round(_ANSWER_TIMEOUT_S * 1e9)
        while len(self._buffer) < len(data):
            heard = self._read((until_ns - self._clock.now_ns()) * 1e-9)
            if not heard:
                break
            self._buffer += heard
        if self._buffer.startswith(data):
            self._buffer = self._buffer[len(data) :]
            return True
        # Another sender collided, or the echo is corrupt: so was perhaps what the servos received.
        self.counters.corrupt += 1
        self._buffer = b""
        return False

    def _receive(self, until_ns: int, longest: int) -> tuple[Packet, ...] | None:
        """Return the received packets, maybe none yet; None if nothing more arrived in time."""
        if not self._buffer or not (found := codec.split(self._buffer, longest)).packets:
            heard = self._read(max(until_ns - self._clock.now_ns(), 0) * 1e-9)
            if not heard:
                return None
            self._buffer += heard
            found = codec.split(self._buffer, longest)
        self._buffer = found.rest
        self.counters.corrupt += found.damaged
        return found.packets

    def _read(self, timeout_s: float) -> bytes:
        import serial

        try:
            until_ns = self._clock.now_ns() + round(1e9 * max(timeout_s, 0.0))
            is_ready = wait_readable(self._clock, self._port.fileno(), until_ns)
            return bytes(self._port.read(_READ_SIZE)) if is_ready else b""
        except (serial.SerialException, OSError, ValueError) as error:
            raise self._gone(error) from None

    def _gone(self, error: Exception) -> DeviceGone:
        return DeviceGone(
            self._device, f"lost connection to the serial port: {error}", hint="check the adapter, then reconnect"
        )
