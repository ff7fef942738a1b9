"""Recorded traffic of Feetech servos: which reply answers which request, and what contradicts our codec and emulator.

A capture is a text file with what was passed on a serial line in both directions: what ``socat -x`` prints, or lines
``SECONDS > HEX`` and ``SECONDS < HEX`` (host to servos, servos to host). No I/O but the reading of that file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Final

from touchcell.drivers.core.difference import Difference
from touchcell.drivers.feetech import codec
from touchcell.drivers.feetech.codec import Instruction, Packet, Register
from touchcell.errors import ConfigError

ANSWERED_WITHIN_S: Final = 0.02
_SOCAT = re.compile(r"([<>]) (\d{4}/\d\d/\d\d \d\d:\d\d:\d\d)\.(\d+)")
_SIMPLE = re.compile(r"(\d+(?:\.\d*)?)\s+([<>])\s+((?:[0-9a-fA-F]{2}\s*)+)")
_HEX = re.compile(r"(?:[0-9a-fA-F]{2}(?:\s+|$))+")
_HOST = ">"
_ASSUMED: Final[Mapping[tuple[int, int], tuple[str, range]]] = MappingProxyType(
    {
        (Register.MODEL, 2): ("model", range(codec.STS3215, codec.STS3215 + 1)),
        (Register.BAUD_RATE, 1): ("baud rate", range(8)),
        (Register.RESPONSE_LEVEL, 1): ("response level", range(2)),
        (Register.MODE, 1): ("mode", range(4)),
        (Register.TORQUE_ENABLE, 1): ("torque enable", range(2)),
        (Register.POSITION, 2): ("position, ticks", range(codec.TICKS_PER_TURN)),
        (Register.VOLTAGE, 1): ("voltage, 0.1 V", range(40, 150)),
        (Register.TEMPERATURE, 1): ("temperature, Celsius", range(100)),
    }
)
"""Values that codec and emulator assume, by register and length."""

_SIGNED = frozenset({Register.POSITION})


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes that passed together: time in s, whether the host sent them, and the bytes."""

    t_s: float
    from_host: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class Request:
    """What a servo was asked: an instruction, and the registers that a reply tells of."""

    servo: int
    code: int
    register: int = 0
    length: int = 0


@dataclass(slots=True)
class RecordedServo:
    """What a capture knows of one servo.

    Attributes:
        replies: replies to each request, in order.
        registers: first value seen of each register.
        delays_s: time from each request to its reply.
        unanswered: requests that a servo answers, and this one did not.
    """

    replies: dict[Request, list[Packet]] = field(default_factory=dict)
    registers: dict[int, int] = field(default_factory=dict)
    delays_s: list[float] = field(default_factory=list)
    unanswered: int = 0


@dataclass(slots=True)
class Capture:
    """Servos of a capture by their number, and what differs from codec and emulator."""

    servos: dict[int, RecordedServo] = field(default_factory=dict)
    differences: list[Difference] = field(default_factory=list)
    frames: int = 0


def read_chunks(path: Path) -> Iterator[Chunk]:
    """Yield what passed on the line. Raises ConfigError naming the file."""
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=str(path)) from None
    found = False
    head: tuple[float, bool] | None = None
    for line in lines:
        if (simple := _SIMPLE.match(line)) is not None:
            found = True
            yield Chunk(float(simple[1]), simple[2] == _HOST, bytes.fromhex(simple[3]))
        elif (socat := _SOCAT.match(line)) is not None:
            seconds = datetime.strptime(socat[2], "%Y/%m/%d %H:%M:%S").timestamp()
            head = (seconds + float(f"0.{socat[3]}"), socat[1] == _HOST)
        elif head is not None and (bytes_found := _HEX.match(line.strip())) is not None:
            found = True
            yield Chunk(*head, bytes.fromhex(bytes_found[0]))
    if not found:
        raise ConfigError(
            "is no record of a serial line",
            file=str(path),
            hint="record one with `socat -x`, see docs/how-to/donate-a-capture.md",
        )


def judge(chunks: Iterator[Chunk]) -> Capture:
    """Assign replies to requests, and note what differs from codec and emulator."""
    capture = Capture()
    rest = {True: b"", False: b""}
    pending: list[tuple[float, int, Request]] = []
    echo: list[Packet] = []
    for chunk in chunks:
        found = codec.split(rest[chunk.from_host] + chunk.data)
        rest[chunk.from_host] = found.rest
        if found.damaged:
            _note(capture, chunk, "framing", "packets only", f"{found.damaged} pieces that are none")
        for packet in found.packets:
            capture.frames += 1
            if chunk.from_host:
                pending += [(chunk.t_s, capture.frames, each) for each in _requests(packet, capture, chunk)]
                echo.append(packet)
            elif packet in echo:
                # The adapter returns what the host has sent.
                echo.remove(packet)
            else:
                _take_reply(packet, chunk, capture, pending)
    for _, _, request in pending:
        _count_unanswered(capture, request)
    return capture


def describe(capture: Capture) -> Iterator[str]:
    """Yield a line for each servo."""
    for number, servo in sorted(capture.servos.items()):
        slowest = f", at most {1e3 * max(servo.delays_s):.1f} ms" if servo.delays_s else ""
        yield f"servo {number}: {len(servo.delays_s)} replies{slowest}; {servo.unanswered} requests without one"


def _note(capture: Capture, chunk: Chunk, name: str, expected: str, seen: str) -> None:
    capture.differences.append(Difference(chunk.t_s, capture.frames, name, expected, seen))


def _requests(packet: Packet, capture: Capture, chunk: Chunk) -> list[Request]:
    """Return what each addressed servo is asked; nothing for what is not answered."""
    data, alone = packet.data, packet.servo != codec.BROADCAST_ID
    if packet.code == Instruction.SYNC_READ and len(data) > 2:
        return [Request(number, Instruction.READ, data[0], data[1]) for number in data[2:]]
    if packet.code == Instruction.READ and alone and len(data) == 2:
        return [Request(packet.servo, Instruction.READ, data[0], data[1])]
    if packet.code in (Instruction.WRITE, Instruction.REG_WRITE) and alone and data:
        return [Request(packet.servo, packet.code, data[0], len(data) - 1)]
    if packet.code in (Instruction.PING, Instruction.ACTION) and alone:
        return [Request(packet.servo, packet.code)]
    if packet.code not in list(Instruction):
        known = ", ".join(f"{code:#x}" for code in Instruction)
        _note(capture, chunk, f"instruction to servo {packet.servo}", f"one of {known}", f"{packet.code:#x}")
    return []


def _take_reply(packet: Packet, chunk: Chunk, capture: Capture, pending: list[tuple[float, int, Request]]) -> None:
    at = next((i for i, (_, _, request) in enumerate(pending) if _answers(packet, request)), None)
    if at is None:
        _note(capture, chunk, f"servo {packet.servo}", "no reply, as nothing asked it", f"{len(packet.data)} bytes")
        return
    asked_s, _, request = pending[at]
    for _, _, earlier in pending[:at]:
        _count_unanswered(capture, earlier)
    del pending[: at + 1]
    servo = capture.servos.setdefault(packet.servo, RecordedServo())
    servo.replies.setdefault(request, []).append(packet)
    servo.delays_s.append(chunk.t_s - asked_s)
    if chunk.t_s - asked_s > ANSWERED_WITHIN_S:
        expected, seen = f"within {1e3 * ANSWERED_WITHIN_S:g} ms", f"after {1e3 * (chunk.t_s - asked_s):.1f} ms"
        _note(capture, chunk, f"servo {packet.servo} reply", expected, seen)
    for fault in codec.faults(packet.code):
        if fault.name.startswith("reserved"):
            _note(capture, chunk, f"servo {packet.servo} error byte", "documented bits", fault.name)
    if request.code == Instruction.READ:
        _judge_registers(packet, request, chunk, capture, servo)


def _answers(packet: Packet, request: Request) -> bool:
    length = request.length if request.code == Instruction.READ else 0
    return packet.servo == request.servo and len(packet.data) == length


def _judge_registers(packet: Packet, request: Request, chunk: Chunk, capture: Capture, servo: RecordedServo) -> None:
    for offset, value in enumerate(packet.data):
        servo.registers.setdefault(request.register + offset, value)
    for (register, length), (name, assumed) in _ASSUMED.items():
        at = register - request.register
        if at >= 0 and at + length <= len(packet.data):
            raw = packet.data[at : at + length]
            value = codec.from_signed_word(raw) if register in _SIGNED else int.from_bytes(raw, "little")
            if value not in assumed:
                expected = str(assumed[0]) if len(assumed) == 1 else f"{assumed[0]} to {assumed[-1]}"
                _note(capture, chunk, f"servo {packet.servo} {name}", expected, str(value))


def _count_unanswered(capture: Capture, request: Request) -> None:
    # A servo of response level 0 does not acknowledge writes, which is documented.
    if request.code in (Instruction.READ, Instruction.PING):
        capture.servos.setdefault(request.servo, RecordedServo()).unanswered += 1
