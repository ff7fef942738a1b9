"""Emulator of a Robotiq 2F gripper: Modbus RTU on a pseudo-terminal, or Modbus TCP.

Fingers move at the requested speed and stop at an object, which they hold; the gripper needs its activation, in which
they close and open once. Forces are not modelled.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from touchcell.drivers.core.errors import CodecError
from touchcell.drivers.robotiq import codec, modbus
from touchcell.drivers.robotiq.codec import Action, ActivationStatus, ObjectStatus, Status
from touchcell.drivers.robotiq.modbus import Function, Message
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.serial_line import PtyLine, SerialLine

_TICK_S = 4e-3
_OPEN, _CLOSED = 3, 230
_COUNTS_PER_MM = (_CLOSED - _OPEN) / 85.0
_SLOWEST_MM_S, _FASTEST_MM_S = 20.0, 150.0
_ACTIVATING_COUNTS_S = 300.0
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_MOVING_A = 0.1


class RobotiqHand(Emulator):
    """Emulator of one gripper.

    Args:
        line: serial line; None for TCP.
        address: host and port for TCP; None for a serial line.
        activated: whether it is activated already when it begins.
    """

    faults: ClassVar[Mapping[str, str]] = {
        "pause": "nothing is answered",
        "drop": "this many replies are lost",
        "delay": "replies arrive this many seconds late",
        "corrupt": "one bit of this many replies is wrong",
        "unplug": "the adapter or cable is unplugged",
        "object": "an object of this width, mm, is between the fingers",
        "fault": "fault code that it reports",
        "never_activates": "its activation does not begin",
        "restart": "the gripper loses power for a moment: it is no longer activated",
        "reset": "return to the state at the start of the emulator",
    }

    def __init__(self, line: SerialLine | None, address: tuple[str, int] | None, *, activated: bool = False) -> None:
        super().__init__()
        self._line = line
        self._address = address
        self._begins_activated = activated
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._ticker: asyncio.Task[None] | None = None
        self._reset()

    def _reset(self) -> None:
        self.active.clear()
        self._energising = 0
        self._requests = 0
        self._commands = 0
        self._buffer = b""
        self._power_up()
        if self._begins_activated:
            self._action = Action(activate=True)
            self._activation = ActivationStatus.ACTIVATED

    def _power_up(self) -> None:
        self._action = Action(activate=False)
        self._activation = ActivationStatus.RESET
        self._closing_first = False
        self._position = float(_OPEN)
        self._met = ObjectStatus.MOVING

    async def start(self) -> None:
        """Open the line or the port, and start the simulated time."""
        await self._plug_in()
        self._ticker = asyncio.create_task(self._tick())

    async def stop(self) -> None:
        """Close it."""
        if self._ticker is not None:
            self._ticker.cancel()
        self._unplug()

    def state(self) -> dict[str, Any]:
        """Return the true opening, what it does, and what it was asked."""
        return {
            "width_mm": (_CLOSED - self._position) / _COUNTS_PER_MM,
            "position": self._position,
            "met": self._met.name.lower(),
            "activation": self._activation.name.lower(),
            "energised": self._action.activate,
            "energising": self._energising,
            "requests": self._requests,
            "commands": self._commands,
            "faults": sorted(self.active),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        """Act at once."""
        if fault == "unplug":
            self._unplug()
        elif fault == "restart":
            self._power_up()
            del self.active[fault]
        elif fault == "reset":
            self._reset()

    def on_clear(self, fault: str) -> None:
        """Plug in again."""
        if fault == "unplug":
            self._plugging = asyncio.get_running_loop().create_task(self._plug_in())

    async def _plug_in(self) -> None:
        if self._line is not None:
            self._line.plug_in(self._on_bytes)
        elif self._address is not None:
            self._server = await asyncio.start_server(self._serve, *self._address)

    def _unplug(self) -> None:
        if self._line is not None:
            self._line.unplug()
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in self._writers:
            writer.transport.abort()

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            self._step(_TICK_S)

    def _step(self, dt_s: float) -> None:
        if self._activation is ActivationStatus.ACTIVATING and "never_activates" not in self.active:
            self._activate(dt_s)
        elif self._activation is ActivationStatus.ACTIVATED and self._action.go and "fault" not in self.active:
            self._go(dt_s)

    def _activate(self, dt_s: float) -> None:
        goal = _CLOSED if self._closing_first else _OPEN
        self._approach(goal, _ACTIVATING_COUNTS_S * dt_s)
        if self._position == goal and not self._closing_first:
            self._activation = ActivationStatus.ACTIVATED
            self._met = ObjectStatus.AT_GOAL
        elif self._position == goal:
            self._closing_first = False

    def _go(self, dt_s: float) -> None:
        goal = min(max(self._action.position, _OPEN), _CLOSED)
        speed_mm_s = _SLOWEST_MM_S + (_FASTEST_MM_S - _SLOWEST_MM_S) * self._action.speed / codec.COUNTS
        before = self._position
        self._approach(goal, speed_mm_s * _COUNTS_PER_MM * dt_s)
        if "object" in self.active:
            at = _CLOSED - float(self.active["object"]) * _COUNTS_PER_MM
            if before <= at <= self._position and goal > at:
                self._position = at
                self._met = ObjectStatus.HELD_CLOSING
                return
        self._met = ObjectStatus.AT_GOAL if self._position == goal else ObjectStatus.MOVING

    def _approach(self, goal: float, step: float) -> None:
        way = goal - self._position
        self._position = goal if abs(way) <= step else self._position + (step if way > 0.0 else -step)

    def _status(self) -> Status:
        fault = int(self.active.get("fault", 0))
        if not fault and self._action.go and self._activation is not ActivationStatus.ACTIVATED:
            fault = 0x05 if self._action.activate else 0x07
        moving = self._met is ObjectStatus.MOVING and self._action.go
        return Status(
            activated=self._action.activate,
            going=self._action.go,
            activation=self._activation,
            met=self._met,
            fault=fault,
            requested=self._action.position,
            position=round(self._position),
            current_a=_MOVING_A if moving else 0.0,
        )

    def _obey(self, action: Action) -> None:
        self._commands += 1
        if action.activate and self._activation is ActivationStatus.RESET:
            self._energising += 1
            self._activation, self._closing_first = ActivationStatus.ACTIVATING, True
        elif not action.activate:
            self._activation = ActivationStatus.RESET
            # A reset clears what is latched.
            self.active.pop("fault", None)
        self._action = action

    def _answer(self, request: Message) -> Message | None:
        if request.unit != codec.UNIT:
            return None
        self._requests += 1
        if request.function in (Function.READ_HOLDING, Function.READ_INPUT) and len(request.data) == 4:
            first, count = struct.unpack(">HH", request.data)
            return self._read(request, first, count)
        if request.function in (Function.WRITE, Function.WRITE_AND_READ):
            return self._write(request)
        return _refusal(request, _ILLEGAL_FUNCTION)

    def _read(self, request: Message, first: int, count: int) -> Message:
        status = codec.encode_status(self._status())
        at = first - codec.INPUT
        if not (at >= 0 and count > 0 and at + count <= len(status)):
            return _refusal(request, _ILLEGAL_ADDRESS)
        values = status[at : at + count]
        return Message(request.unit, request.function, struct.pack(f">B{count}H", 2 * count, *values))

    def _write(self, request: Message) -> Message:
        both = request.function == Function.WRITE_AND_READ
        data = request.data[4:] if both else request.data
        first, count, size = struct.unpack_from(">HHB", data.ljust(5, b"\0"))
        if size != 2 * count or len(data) != 5 + size:
            return _refusal(request, _ILLEGAL_VALUE)
        at = first - codec.OUTPUT
        if not (at >= 0 and count and at + count <= codec.REGISTERS):
            return _refusal(request, _ILLEGAL_ADDRESS)
        registers = list(codec.encode_action(self._action))
        registers[at : at + count] = struct.unpack_from(f">{count}H", data, 5)
        self._obey(codec.decode_action((registers[0], registers[1], registers[2])))
        if both:
            return self._read(request, *struct.unpack_from(">HH", request.data))
        return Message(request.unit, request.function, struct.pack(">HH", first, count))

    def _reply_to(self, request: Message) -> Message | None:
        """Return the reply that is sent, after the faults of the link."""
        if "pause" in self.active:
            return None
        reply = self._answer(request)
        return None if reply is None or self.spend("drop") else reply

    def _on_bytes(self, heard: bytes) -> None:
        self._buffer += heard
        try:
            while (length := modbus.rtu_length(self._buffer, is_request=True)) and len(self._buffer) >= length:
                frame, self._buffer = self._buffer[:length], self._buffer[length:]
                reply = self._reply_to(modbus.decode_rtu(frame))
                if reply is not None:
                    self._later(modbus.encode_rtu(reply), self._put)
        except CodecError:
            # What is not understood is not answered, and the next request begins anew.
            self._buffer = b""

    def _put(self, data: bytes) -> None:
        if self._line is not None:
            self._line.write(data)

    def _later(self, data: bytes, put: Any) -> None:
        if self.spend("corrupt"):
            data = data[:-3] + bytes([data[-3] ^ 0x10]) + data[-2:]
        delay_s = float(self.active.get("delay", 0.0))
        if delay_s > 0.0:
            asyncio.get_running_loop().call_later(delay_s, put, data)
        else:
            put(data)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        stream = b""
        try:
            with contextlib.suppress(ConnectionError, CodecError):
                while piece := await reader.read(4096):
                    found, stream = modbus.split_tcp(stream + piece)
                    for transaction, request in found:
                        reply = self._reply_to(request)
                        if reply is not None:
                            data = modbus.encode_tcp(reply, transaction)
                            if self.spend("corrupt"):
                                data = data[:2] + b"\xff\xff" + data[4:]
                            self._later(data, writer.write)
        finally:
            self._writers.discard(writer)
            writer.close()


def _refusal(request: Message, code: int) -> Message:
    return Message(request.unit, request.function | modbus.ERROR_BIT, bytes([code]))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of ``touchcell emulate robotiq``."""
    parser.add_argument("--link", type=Path, help="symbolic link to make; clients open it as a port (Modbus RTU)")
    parser.add_argument("--host", help="loopback address to listen on (Modbus TCP)")
    parser.add_argument("--tcp-port", type=int, default=502, help="port there")
    parser.add_argument("--activated", action="store_true", help="it is activated already")


def build(arguments: argparse.Namespace) -> RobotiqHand:
    """Build the emulator from its command-line arguments. Raises ConfigError."""
    if (arguments.link is None) == (arguments.host is None):
        raise ConfigError("needs either --link or --host", key="--link")
    line = PtyLine(arguments.link) if arguments.link is not None else None
    address = None if arguments.host is None else (arguments.host, arguments.tcp_port)
    return RobotiqHand(line, address, activated=arguments.activated)
