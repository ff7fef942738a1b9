"""The emulated Franka Hand: the gripper's interface, version 3, on TCP 1338 and UDP.

Requests and replies are ``u16 command, u32 command id, u32 total size`` and a payload, packed and little-endian; a
reply begins with a 16-bit status and is sent when the motion has ended. States are sent as datagrams. Source:
libfranka-common, ``gripper/types.h``. Fingers move at a constant speed, and an object between them stops them.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import struct
from enum import IntEnum
from typing import Final, NamedTuple

PORT: Final = 1338
VERSION: Final = 3
MAX_WIDTH_M: Final = 0.08
STATE_EVERY: Final = 30
_FASTEST_M_S: Final = 0.1
_HOMING_M_S: Final = 0.05
_TEMPERATURE_C: Final = 33
_HEADER: Final = struct.Struct("<HII")
_STATE: Final = struct.Struct("<Idd?H")


class Command(IntEnum):
    """Commands of a client."""

    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


class Status(IntEnum):
    """Outcome of a command."""

    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3


_PAYLOAD: Final = {
    Command.CONNECT: struct.Struct("<HH"),
    Command.HOMING: struct.Struct("<"),
    Command.GRASP: struct.Struct("<5d"),
    Command.MOVE: struct.Struct("<2d"),
    Command.STOP: struct.Struct("<"),
}
_INCOMPATIBLE: Final = 1


class _Task(NamedTuple):
    """A motion in progress: its command and id, where it goes and how fast, and within which widths it succeeds."""

    command: Command
    command_id: int
    target_m: float
    speed_m_s: float
    lowest_m: float
    highest_m: float


class EmulatedHand:
    """Hand and its server for one client.

    Args:
        host: address to bind.

    Attributes:
        width_m: opening of the fingers.
        object_m: width of an object between them, None without one.
        is_grasped: whether the fingers hold the object.
        forgets: whether nothing is read or sent, as behind an unplugged cable.
    """

    def __init__(self, host: str) -> None:
        self._host = host
        self.width_m = 0.04
        self.object_m: float | None = None
        self.is_grasped = False
        self.forgets = False
        self._task: _Task | None = None
        self._server: asyncio.Server | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._udp: socket.socket | None = None
        self._client_udp: tuple[str, int] | None = None
        self._ticks = 0

    async def start(self) -> None:
        """Listen."""
        self._server = await asyncio.start_server(self._serve, self._host, PORT, reuse_address=True)
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((self._host, 0))
        self._udp.setblocking(False)

    def stop(self) -> None:
        """Close every connection."""
        if self._server is not None:
            self._server.close()
        if self._writer is not None:
            self._writer.transport.abort()
        if self._udp is not None:
            self._udp.close()
        self._client_udp = None

    def step(self, dt_s: float) -> None:
        """Move for ``dt_s``, and send a state now and then."""
        self._move(dt_s)
        self._ticks += 1
        if self._ticks % STATE_EVERY == 0 and self._client_udp is not None and not self.forgets:
            assert self._udp is not None
            state = _STATE.pack(self._ticks, self.width_m, MAX_WIDTH_M, self.is_grasped, _TEMPERATURE_C)
            with contextlib.suppress(BlockingIOError):
                self._udp.sendto(state, self._client_udp)

    def _move(self, dt_s: float) -> None:
        task = self._task
        if task is None:
            return
        step = min(task.speed_m_s, _FASTEST_M_S) * dt_s
        way = task.target_m - self.width_m
        width = task.target_m if abs(way) <= step else self.width_m + math.copysign(step, way)
        held = self.object_m is not None and width <= self.object_m <= self.width_m and way < 0.0
        if held:
            assert self.object_m is not None
            width = self.object_m
        elif way > 0.0:
            self.is_grasped = False
        self.width_m = width
        if held or width == task.target_m:
            self._finish(task, held=held)

    def _finish(self, task: _Task, *, held: bool) -> None:
        self._task = None
        if task.command is Command.GRASP:
            self.is_grasped = held and task.lowest_m <= self.width_m <= task.highest_m
            status = Status.SUCCESS if self.is_grasped else Status.UNSUCCESSFUL
        else:
            status = Status.UNSUCCESSFUL if held and self.width_m != task.target_m else Status.SUCCESS
        self._reply(task.command, task.command_id, status)

    def _reply(self, command: Command, command_id: int, status: int, payload: bytes = b"") -> None:
        if self._writer is not None and not self._writer.is_closing() and not self.forgets:
            body = struct.pack("<H", status) + payload
            self._writer.write(_HEADER.pack(command, command_id, _HEADER.size + len(body)) + body)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._writer is not None:
            writer.close()
            return
        self._writer = writer
        try:
            while True:
                number, command_id, size = _HEADER.unpack(await reader.readexactly(_HEADER.size))
                if number not in list(Command) or size != _HEADER.size + _PAYLOAD[Command(number)].size:
                    return
                payload = await reader.readexactly(size - _HEADER.size)
                if not self.forgets:
                    self._obey(Command(number), command_id, payload)
        except (asyncio.IncompleteReadError, ConnectionError):
            return
        finally:
            self._writer, self._client_udp = None, None
            writer.close()

    def _obey(self, command: Command, command_id: int, payload: bytes) -> None:
        values = _PAYLOAD[command].unpack(payload)
        if command is Command.CONNECT:
            version, port = values
            status = 0 if version == VERSION else _INCOMPATIBLE
            self._reply(command, command_id, status, struct.pack("<H", VERSION))
            assert self._writer is not None
            if status == 0:
                self._client_udp = (self._writer.get_extra_info("peername")[0], port)
            return
        # Any command ends the one before it.
        if self._task is not None:
            self._reply(self._task.command, self._task.command_id, Status.ABORTED)
            self._task = None
        if command is Command.STOP:
            self._reply(command, command_id, Status.SUCCESS)
        elif command is Command.HOMING:
            self._task = _Task(command, command_id, MAX_WIDTH_M, _HOMING_M_S, 0.0, MAX_WIDTH_M)
        else:
            self._begin(command, command_id, values)

    def _begin(self, command: Command, command_id: int, values: tuple[float, ...]) -> None:
        width, speed = values[0], values[3] if command is Command.GRASP else values[1]
        possible = all(math.isfinite(value) for value in values) and 0.0 <= width <= MAX_WIDTH_M and speed > 0.0
        if not possible:
            self._reply(command, command_id, Status.FAIL)
        elif command is Command.GRASP:
            inner, outer = values[1], values[2]
            self._task = _Task(command, command_id, max(width - inner, 0.0), speed, width - inner, width + outer)
        else:
            self._task = _Task(command, command_id, width, speed, 0.0, MAX_WIDTH_M)
