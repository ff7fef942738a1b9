"""Wire format of Feetech STS bus servos: pure functions between bytes and values, no I/O.

Packets in both directions are ``FF FF id length code data... checksum``: length counts code, data and checksum; code is
an instruction to a servo or the error byte of its reply; the checksum is the inverted low byte of the sum from id to
the last data byte. Numbers are little-endian, with a separate sign bit. Sources: Feetech's "SMS/STS series memory
table" and "communication protocol manual", as restated by the Unlicense feetech-servo-sdk 1.0.0 and by LeRobot's
tables.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType

from touchcell.drivers.core.errors import CodecError, FaultClass, Remedy

TICKS_PER_TURN = 4096
RAD_PER_TICK = 2.0 * math.pi / TICKS_PER_TURN
BROADCAST_ID = 0xFE
STS3215 = 777
"""Model number."""

_HEADER = b"\xff\xff"
_LONGEST_DATA = 253
_OVERHEAD = 6


class Instruction(IntEnum):
    """Instruction byte of a request."""

    PING = 1
    READ = 2
    WRITE = 3
    REG_WRITE = 4
    ACTION = 5
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Register(IntEnum):
    """Register addresses used by the driver; those below 40 are non-volatile."""

    FIRMWARE = 0
    MODEL = 3
    ID = 5
    BAUD_RATE = 6
    RETURN_DELAY = 7
    RESPONSE_LEVEL = 8
    MIN_TICKS = 9
    MAX_TICKS = 11
    MAX_TORQUE = 16
    PHASE = 18
    PROTECTION_TIME = 35
    OVERLOAD_TORQUE = 36
    HOMING_OFFSET = 31
    MODE = 33
    TORQUE_ENABLE = 40
    GOAL_POSITION = 42
    TORQUE_LIMIT = 48
    LOCK = 55
    POSITION = 56
    SPEED = 58
    LOAD = 60
    VOLTAGE = 62
    TEMPERATURE = 63
    STATUS = 65
    CURRENT = 69


TORQUE_OFF, TORQUE_ON = 0, 1
POSITION_MODE = 0
"""Value of ``Register.MODE``."""

IDENTITY_LENGTH = 50
"""Number of bytes from ``Register.FIRMWARE`` that ``decode_identity`` reads; more than any state block has."""

STATE_STARTS = tuple(range(Register.TORQUE_ENABLE - 15, Register.TORQUE_ENABLE + 1))
"""First addresses of the blocks that ``decode_state`` reads; all end behind ``Register.CURRENT``, so that the length of
a reply identifies its request."""

_STATE_END = Register.CURRENT + 2
_RETURN_DELAY_UNIT_S = 2e-6
_CURRENT_UNIT_A = 6.5e-3


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet: an instruction to ``servo`` or, with the error byte as ``code``, its reply."""

    servo: int
    code: int
    data: bytes = b""


@dataclass(frozen=True, slots=True)
class Found:
    """Packets found in a buffer.

    Attributes:
        packets: complete packets with a valid checksum, in order.
        rest: bytes that may be the beginning of another packet.
        damaged: number of invalid sequences that were skipped.
    """

    packets: tuple[Packet, ...]
    rest: bytes
    damaged: int


@dataclass(frozen=True, slots=True)
class Identity:
    """Non-volatile settings of a servo.

    Attributes:
        return_delay_s: delay before a reply.
        acknowledges: whether it also replies to writes.
        min_ticks, max_ticks: goal limits enforced by the servo.
        multi_turn: whether it counts turns instead of wrapping at 4096.
        speed_unit_ticks_s: one unit of its speeds.
        homing_offset_ticks: offset subtracted from the encoder.
        firmware: version.
    """

    model: int
    servo: int
    return_delay_s: float
    acknowledges: bool
    min_ticks: int
    max_ticks: int
    multi_turn: bool
    speed_unit_ticks_s: int
    homing_offset_ticks: int
    mode: int
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class ServoState:
    """State of one servo in a control cycle; positions in ticks, speeds in the servo's own unit.

    Attributes:
        load: duty cycle of the motor, -1 to 1; not a torque.
        status: bits of ``FAULT_BITS``.
    """

    torque_enable: int
    goal: int
    torque_limit: int
    position: int
    speed: int
    load: float
    voltage_v: float
    temperature_c: int
    status: int
    current_a: float


@dataclass(frozen=True, slots=True)
class FaultBit:
    """Meaning of one status bit: fault class, remedy and hint."""

    name: str
    fault_class: FaultClass
    needs: Remedy
    hint: str


FAULT_BITS: Mapping[int, FaultBit] = MappingProxyType(
    {
        0: FaultBit(
            "voltage out of range", FaultClass.ELECTRICAL, Remedy.OPERATOR, "check the supply under load, and its plug"
        ),
        1: FaultBit("encoder error", FaultClass.INTERNAL, Remedy.SERVICE, "replace the servo"),
        2: FaultBit("too hot", FaultClass.THERMAL, Remedy.OPERATOR, "let it cool down, and lighten the load"),
        3: FaultBit(
            "too much current", FaultClass.OVERLOAD, Remedy.RECOVER, "check for a collision or a short circuit"
        ),
        5: FaultBit(
            "overload",
            FaultClass.OVERLOAD,
            Remedy.RECOVER,
            "it keeps a fifth of its torque until its torque is switched off: support the arm, then recover",
        ),
    }
    | {
        bit: FaultBit(f"reserved bit {bit}", FaultClass.INTERNAL, Remedy.SERVICE, "undocumented by Feetech")
        for bit in (4, 6, 7)
    }
)


def faults(status: int) -> tuple[FaultBit, ...]:
    """Return the faults in a status or error byte, lowest bit first."""
    return tuple(FAULT_BITS[bit] for bit in range(8) if status >> bit & 1)


def encode(packet: Packet) -> bytes:
    """Encode a packet. Raises CodecError for an id above the broadcast id or too much data."""
    if not 0 <= packet.servo <= BROADCAST_ID:
        raise CodecError("servo", packet.servo, "is not a valid id")
    if len(packet.data) > _LONGEST_DATA:
        raise CodecError("data", len(packet.data), f"is more than {_LONGEST_DATA} bytes")
    body = bytes([packet.servo, len(packet.data) + 2, packet.code]) + packet.data
    return _HEADER + body + bytes([_checksum(body)])


def split(buffer: bytes, longest: int = _LONGEST_DATA) -> Found:
    """Find the packets in ``buffer``; ``longest``: most data bytes expected, so that a corrupt length does not swallow
    the packets behind it."""
    packets: list[Packet] = []
    damaged = 0
    at = 0
    while True:
        start = buffer.find(_HEADER, at)
        if start < 0:
            rest = b"\xff" if buffer[at:].endswith(b"\xff") else b""
            return Found(tuple(packets), rest, damaged + (len(buffer) - at > len(rest)))
        damaged += start > at
        if len(buffer) < start + 4:
            return Found(tuple(packets), buffer[start:], damaged)
        servo, length = buffer[start + 2], buffer[start + 3]
        end = start + 4 + length
        if servo <= BROADCAST_ID and 2 <= length <= longest + 2:
            if len(buffer) < end:
                return Found(tuple(packets), buffer[start:], damaged)
            if buffer[end - 1] == _checksum(buffer[start + 2 : end - 1]):
                packets.append(Packet(servo, buffer[start + 4], buffer[start + 5 : end - 1]))
                at = end
                continue
        if servo != 0xFF:
            damaged += 1
        # An apparent header may be data: the next one may begin one byte further on.
        at = start + 1
        if buffer[at : at + 2] != _HEADER:
            at += 1


def read(servo: int, register: int, length: int) -> bytes:
    """Request ``length`` bytes from ``register`` of ``servo``."""
    return encode(Packet(servo, Instruction.READ, bytes([register, length])))


def write(servo: int, register: int, data: bytes) -> bytes:
    """Write ``data`` from ``register`` on."""
    return encode(Packet(servo, Instruction.WRITE, bytes([register]) + data))


def sync_read(servos: tuple[int, ...], register: int, length: int) -> bytes:
    """Request the same registers of ``servos``; each replies, in this order."""
    return encode(Packet(BROADCAST_ID, Instruction.SYNC_READ, bytes([register, length, *servos])))


def sync_write(register: int, data: Mapping[int, bytes]) -> bytes:
    """Write equally long data to each servo at once, without replies. Raises CodecError for unequal lengths."""
    lengths = {len(piece) for piece in data.values()}
    if len(lengths) != 1:
        raise CodecError("data", sorted(lengths), "is not equally long for all servos")
    body = b"".join(bytes([servo]) + piece for servo, piece in data.items())
    return encode(Packet(BROADCAST_ID, Instruction.SYNC_WRITE, bytes([register, lengths.pop()]) + body))


def goal(ticks: int, speed: int) -> bytes:
    """Encode the registers from ``Register.GOAL_POSITION`` on for a move to ``ticks`` at ``speed`` in the servo's unit.

    Raises:
        CodecError: out of range, or the speed is zero, which some servos interpret as their maximum.
    """
    if speed <= 0:
        raise CodecError("speed", speed, "is not positive")
    return signed_word(ticks) + word(0) + signed_word(speed)


def word(value: int) -> bytes:
    """Encode an unsigned 16-bit number. Raises CodecError."""
    if not 0 <= value <= 0xFFFF:
        raise CodecError("value", value, "does not fit 16 bits")
    return value.to_bytes(2, "little")


def signed_word(value: int, sign_bit: int = 15) -> bytes:
    """Encode a 16-bit number in sign-magnitude form. Raises CodecError."""
    if abs(value) >= 1 << sign_bit:
        raise CodecError("value", value, f"does not fit {sign_bit} bits and a sign")
    return word(abs(value) | (1 << sign_bit if value < 0 else 0))


def from_signed_word(data: bytes, sign_bit: int = 15) -> int:
    """Decode ``signed_word``; bits above the sign are ignored."""
    raw = int.from_bytes(data, "little")
    magnitude = raw & ((1 << sign_bit) - 1)
    return -magnitude if raw >> sign_bit & 1 else magnitude


def decode_identity(data: bytes) -> Identity:
    """Decode the first 50 registers of a servo. Raises CodecError."""
    if len(data) != IDENTITY_LENGTH:
        raise CodecError("identity", len(data), f"is not {IDENTITY_LENGTH} bytes long")
    phase = data[Register.PHASE]
    return Identity(
        model=_word_at(data, Register.MODEL),
        servo=data[Register.ID],
        return_delay_s=data[Register.RETURN_DELAY] * _RETURN_DELAY_UNIT_S,
        acknowledges=data[Register.RESPONSE_LEVEL] != 0,
        min_ticks=_word_at(data, Register.MIN_TICKS),
        max_ticks=_word_at(data, Register.MAX_TICKS),
        multi_turn=bool(phase & 0x10),
        speed_unit_ticks_s=1 if phase & 0x04 else 50,
        homing_offset_ticks=from_signed_word(data[Register.HOMING_OFFSET : Register.HOMING_OFFSET + 2], 11),
        mode=data[Register.MODE],
        firmware=f"{data[Register.FIRMWARE]}.{data[Register.FIRMWARE + 1]}",
    )


def state_length(start: int) -> int:
    """Return the length in bytes of the state block that begins at ``start``."""
    return _STATE_END - start


def decode_state(data: bytes) -> ServoState:
    """Decode a state block of any start address.

    Raises:
        CodecError: wrong length, or a position more than one turn outside 0 to 4095.
    """
    start = _STATE_END - len(data)
    if start not in STATE_STARTS:
        raise CodecError("state", len(data), "is not the length of a state block")

    def at(register: int, length: int = 2) -> bytes:
        return data[register - start : register - start + length]

    position = from_signed_word(at(Register.POSITION))
    # A homing offset moves the count: a single-turn servo may report from -4095 to 8190.
    if not -TICKS_PER_TURN < position < 2 * TICKS_PER_TURN:
        raise CodecError("position", position, "is more than one turn out of range")
    return ServoState(
        torque_enable=at(Register.TORQUE_ENABLE)[0],
        goal=from_signed_word(at(Register.GOAL_POSITION)),
        torque_limit=int.from_bytes(at(Register.TORQUE_LIMIT), "little"),
        position=position,
        speed=from_signed_word(at(Register.SPEED)),
        load=from_signed_word(at(Register.LOAD), 10) / 1000.0,
        voltage_v=at(Register.VOLTAGE)[0] / 10.0,
        temperature_c=at(Register.TEMPERATURE)[0],
        status=at(Register.STATUS)[0],
        current_a=from_signed_word(at(Register.CURRENT)) * _CURRENT_UNIT_A,
    )


def unwrap(ticks: int, centre: float) -> int:
    """Return the count nearest to ``centre`` that reads as ``ticks`` on a servo that wraps at 4096."""
    turns = round((centre - ticks) / TICKS_PER_TURN)
    return ticks + turns * TICKS_PER_TURN


def cycle_time_s(servos: int, baudrate: int, return_delay_s: float) -> float:
    """Return the longest time on the wire, ten bits a byte, of a control cycle: sync write of goals, sync read of
    states.

    ``return_delay_s`` is the sum over the servos.
    """
    goals = _OVERHEAD + 2 + 7 * servos
    request = _OVERHEAD + 2 + servos
    answers = servos * (_OVERHEAD + state_length(STATE_STARTS[0]))
    return 10.0 * (goals + request + answers) / baudrate + return_delay_s


def _checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF


def _word_at(data: bytes, register: int) -> int:
    return int.from_bytes(data[register : register + 2], "little")
