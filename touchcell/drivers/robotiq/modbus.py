"""Wire format of the parts of Modbus that a gripper needs: pure functions, no I/O.

RTU frames are ``unit, function, data, CRC-16``; TCP frames ``transaction, 0, length, unit, function, data`` without
CRC. Functions: 3 and 4 read registers, 16 writes registers, 23 writes and then reads. Source: Modbus Organization,
"MODBUS Application Protocol Specification V1.1b3" and "MODBUS over Serial Line V1.02".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from touchcell.drivers.core.errors import CodecError

ERROR_BIT: Final = 0x80
_RTU_SHORTEST, _MBAP = 4, 7
_LONGEST = 260
# Coils, inputs and single registers: requests of known length that no gripper has.
_OTHER_SHORT = frozenset({1, 2, 5, 6})


class Function(IntEnum):
    """Functions that are spoken."""

    READ_HOLDING = 3
    READ_INPUT = 4
    WRITE = 16
    WRITE_AND_READ = 23


@dataclass(frozen=True, slots=True)
class Message:
    """One request or reply: unit, function (with the error bit in a refusal), and its data."""

    unit: int
    function: int
    data: bytes


def crc(body: bytes) -> int:
    """Return the CRC-16 of an RTU frame."""
    value = 0xFFFF
    for byte in body:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value


def encode_rtu(message: Message) -> bytes:
    """Encode for a serial line."""
    body = bytes([message.unit, message.function]) + message.data
    return body + struct.pack("<H", crc(body))


def encode_tcp(message: Message, transaction: int) -> bytes:
    """Encode for a TCP connection."""
    body = bytes([message.unit, message.function]) + message.data
    return struct.pack(">HHH", transaction & 0xFFFF, 0, len(body)) + body


def decode_rtu(frame: bytes) -> Message:
    """Decode one whole frame of a serial line. Raises CodecError."""
    if len(frame) < _RTU_SHORTEST:
        raise CodecError("frame", len(frame), "is too short")
    if struct.unpack("<H", frame[-2:])[0] != crc(frame[:-2]):
        raise CodecError("checksum", frame[-2:].hex(), "is wrong")
    return Message(frame[0], frame[1], frame[2:-2])


def split_tcp(stream: bytes) -> tuple[list[tuple[int, Message]], bytes]:
    """Return the whole messages in a stream with their transactions, and the rest. Raises CodecError."""
    found = []
    while len(stream) >= _MBAP + 1:
        transaction, protocol, length = struct.unpack_from(">HHH", stream)
        if protocol != 0 or not 2 <= length <= _LONGEST:
            raise CodecError("header", stream[:6].hex(), "is not of Modbus")
        if len(stream) < 6 + length:
            break
        body = stream[6 : 6 + length]
        found.append((transaction, Message(body[0], body[1], body[2:])))
        stream = stream[6 + length :]
    return found, stream


def rtu_length(frame: bytes, *, is_request: bool) -> int | None:
    """Return the length of the RTU frame that begins with ``frame``, or None if that is not known yet.

    Raises:
        CodecError: a function that is not spoken here.
    """
    if len(frame) < 2:
        return None
    function = frame[1]
    if is_request and function in _OTHER_SHORT:
        return 8
    if not is_request and function & ERROR_BIT:
        return 5
    if function not in list(Function):
        raise CodecError("function", function, "is not spoken")
    is_fixed = (
        function == Function.WRITE if not is_request else function in (Function.READ_HOLDING, Function.READ_INPUT)
    )
    if is_fixed:
        return 8
    at = {Function.WRITE: 6, Function.WRITE_AND_READ: 10}.get(Function(function), 2) if is_request else 2
    return None if len(frame) <= at else at + 1 + frame[at] + 2


def read(unit: int, first: int, count: int, function: Function = Function.READ_HOLDING) -> Message:
    """Request ``count`` registers."""
    return Message(unit, function, struct.pack(">HH", first, count))


def write(unit: int, first: int, values: tuple[int, ...]) -> Message:
    """Request to write registers."""
    return Message(
        unit, Function.WRITE, struct.pack(f">HHB{len(values)}H", first, len(values), 2 * len(values), *values)
    )


def decode_registers(reply: Message, count: int) -> tuple[int, ...]:
    """Return the registers of a reply to a read. Raises CodecError for a refusal or another length."""
    _require_no_refusal(reply)
    if len(reply.data) != 1 + 2 * count or reply.data[0] != 2 * count:
        raise CodecError("reply", len(reply.data), f"does not have {count} registers")
    return struct.unpack(f">{count}H", reply.data[1:])


def decode_written(reply: Message, first: int, count: int) -> None:
    """Check the reply to a write. Raises CodecError."""
    _require_no_refusal(reply)
    if reply.data != struct.pack(">HH", first, count):
        raise CodecError("reply", reply.data.hex(), f"does not confirm {count} registers from {first:#06x}")


def _require_no_refusal(reply: Message) -> None:
    if reply.function & ERROR_BIT:
        raise CodecError("function", reply.function & ~ERROR_BIT, f"is refused with code {reply.data.hex()}")
