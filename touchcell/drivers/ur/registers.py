"""Connection to the RTDE registers shared by a UR controller and its control program. No threads, no retries."""

from __future__ import annotations

import socket

from touchcell.drivers.core.clock import Clock, wait_readable
from touchcell.drivers.core.errors import CorruptMessage, DeviceGone, TransportTimeout
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.codec import Packet, PacketType, Recipe, Value

RATE_HZ = 500.0
OUTPUTS = (
    "runtime_state",
    "output_int_register_0",
    "output_int_register_2",
    *(f"output_double_register_{i}" for i in range(6)),
)
COMMAND = ("input_int_register_0", "input_int_register_1", *(f"input_double_register_{i}" for i in range(8)))
KICK = ("input_int_register_0",)
_LARGEST_READ = 1 << 16


class RtdeWire:
    """One RTDE connection, with request and reply during setup.

    Args:
        device: name for errors.
        host: address of the controller.
        timeout_s: timeout of the connection and of each reply.
        clock: the host's clock.

    Raises:
        OSError: the controller cannot be reached.
    """

    def __init__(self, device: str, host: str, timeout_s: float, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._timeout_s = timeout_s
        self._stream = b""
        self._socket = socket.create_connection((host, ur_codec.PORT), timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def close(self) -> None:
        """Close the connection; idempotent."""
        self._socket.close()

    def ask(self, request: Packet) -> Packet:
        """Send ``request`` and return the reply. Raises TransportTimeout, DeviceGone, CorruptMessage."""
        self.send(request)
        deadline_ns = self._clock.now_ns() + round(1e9 * self._timeout_s)
        while (left_ns := deadline_ns - self._clock.now_ns()) > 0:
            for packet in self.receive(left_ns * 1e-9):
                if packet.kind is request.kind:
                    return packet
        raise TransportTimeout(self._device, f"reply to {request.kind.name}", self._timeout_s)

    def send(self, packet: Packet) -> None:
        """Send at once or raise DeviceGone: a controller that does not read counts as lost."""
        data = ur_codec.encode(packet)
        try:
            sent = self._socket.send(data)
        except OSError as error:
            raise DeviceGone(self._device, f"RTDE connection: {error}") from error
        if sent != len(data):
            raise DeviceGone(self._device, "RTDE connection: the controller does not read")

    def receive(self, timeout_s: float) -> list[Packet]:
        """Return received packets, waiting for the first up to ``timeout_s``. Raises DeviceGone, CorruptMessage."""
        if timeout_s > 0.0:
            wait_readable(self._clock, self._socket.fileno(), self._clock.now_ns() + round(1e9 * timeout_s))
        try:
            piece = self._socket.recv(_LARGEST_READ)
        except BlockingIOError:
            return []
        except OSError as error:
            raise DeviceGone(self._device, f"RTDE connection: {error}") from error
        if not piece:
            raise DeviceGone(self._device, "RTDE connection: closed by the controller")
        packets, self._stream = ur_codec.split(self._stream + piece)
        return packets


class Registers:
    """The control program's registers, claimed by this client.

    Raises on construction:
        DeviceGone: unreachable, or closed.
        TransportTimeout: no reply.
        CorruptMessage: the registers do not exist, or another client owns them.
    """

    def __init__(self, device: str, host: str, timeout_s: float, clock: Clock) -> None:
        self._device = device
        try:
            self._wire = RtdeWire(device, host, timeout_s, clock)
        except OSError as error:
            raise DeviceGone(device, f"RTDE of {host}: {error}") from error
        try:
            self._wire.ask(ur_codec.version_request())
            self._outputs = self._recipe(ur_codec.setup_outputs(RATE_HZ, OUTPUTS), OUTPUTS)
            self._command = self._recipe(ur_codec.setup_inputs(COMMAND), COMMAND)
            self._kick = self._recipe(ur_codec.setup_inputs(KICK), KICK)
            self._wire.ask(Packet(PacketType.START))
        except BaseException:
            self._wire.close()
            raise
        self._values: dict[str, Value] = {}

    def close(self) -> None:
        """Release the registers; idempotent."""
        self._wire.close()

    def command(self, number: int, doubles: list[float], asynchronous: bool = False) -> None:
        """Write a command and its arguments (up to eight) in one packet. Raises DeviceGone."""
        arguments = doubles + [0.0] * (len(COMMAND) - 2 - len(doubles))
        values = dict(zip(COMMAND, (number, int(asynchronous), *arguments), strict=True))
        self._wire.send(Packet(PacketType.DATA, self._command.pack(values)))

    def feed_watchdog(self) -> None:
        """Write "no command", which feeds the watchdog. Raises DeviceGone."""
        self._wire.send(Packet(PacketType.DATA, self._kick.pack({KICK[0]: 0})))

    def read(self, timeout_s: float = 0.0) -> dict[str, Value]:
        """Return the newest outputs by name, waiting up to ``timeout_s`` for newer ones; empty before the first.

        Raises:
            DeviceGone, CorruptMessage: the connection is no longer usable.
        """
        for packet in self._wire.receive(timeout_s):
            if packet.kind is PacketType.DATA:
                self._values = self._outputs.unpack(packet.payload)
        return self._values

    def _recipe(self, request: Packet, names: tuple[str, ...]) -> Recipe:
        answer = self._wire.ask(request)
        types = ur_codec.parse_names(answer.payload[1:])
        if ur_codec.IN_USE in types:
            raise CorruptMessage(
                self._device,
                "the RTDE registers are in use by another client",
                hint="disable EtherNet/IP, PROFINET and MODBUS on the controller, or stop the other client",
            )
        return ur_codec.parse_recipe_answer(answer.payload, names)
