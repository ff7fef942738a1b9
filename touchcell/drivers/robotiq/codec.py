"""Registers of Robotiq 2F-85 and 2F-140 grippers: pure functions between bytes and values, no I/O.

Three registers are written from 0x03E8 and three read from 0x07D0. Source: Robotiq, "2F-85 & 2F-140 Instruction
Manual", chapter Control. Widths are linear in the position count between an open and a closed end, which differ by
gripper and fingertips (about 3 and 230).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Final

from touchcell.drivers.core.errors import CodecError, FaultClass, Remedy

OUTPUT: Final = 0x03E8
INPUT: Final = 0x07D0
REGISTERS: Final = 3
UNIT: Final = 9
COUNTS: Final = 255
CURRENT_A: Final = 0.01
_ACTIVATE, _GO = 0x01, 0x08


class ObjectStatus(IntEnum):
    """What the fingers met."""

    MOVING = 0
    HELD_OPENING = 1
    HELD_CLOSING = 2
    AT_GOAL = 3


class ActivationStatus(IntEnum):
    """Progress of the activation."""

    RESET = 0
    ACTIVATING = 1
    RESERVED = 2
    ACTIVATED = 3


@dataclass(frozen=True, slots=True)
class Action:
    """What the gripper shall do; counts 0 to 255, position 0 is open."""

    activate: bool
    go: bool = False
    position: int = 0
    speed: int = 0
    force: int = 0


@dataclass(frozen=True, slots=True)
class Status:
    """What the gripper reports; positions in counts."""

    activated: bool
    going: bool
    activation: ActivationStatus
    met: ObjectStatus
    fault: int
    requested: int
    position: int
    current_a: float


@dataclass(frozen=True, slots=True)
class FaultCode:
    """Meaning of a fault code: class, remedy and hint."""

    name: str
    fault_class: FaultClass
    needs: Remedy
    hint: str


PENDING: Final = frozenset({0x05, 0x07})
"""Codes of a gripper that is not activated, which are no faults."""

_RESET = "recover activates it anew: its fingers move through their whole range"
FAULTS: Mapping[int, FaultCode] = MappingProxyType(
    {
        0x08: FaultCode("too hot", FaultClass.THERMAL, Remedy.OPERATOR, "let it cool down"),
        0x09: FaultCode("no communication for 1 s", FaultClass.COMMUNICATION, Remedy.RECOVER, _RESET),
        0x0A: FaultCode("under-voltage", FaultClass.ELECTRICAL, Remedy.OPERATOR, "check its 24 V supply"),
        0x0B: FaultCode(
            "automatic release runs", FaultClass.SAFETY_STOP, Remedy.OPERATOR, "wait for its end, then recover"
        ),
        0x0C: FaultCode("internal fault", FaultClass.INTERNAL, Remedy.SERVICE, "ask Robotiq"),
        0x0D: FaultCode("activation fault", FaultClass.MOTION, Remedy.RECOVER, "is something in its way? " + _RESET),
        0x0E: FaultCode("over-current", FaultClass.OVERLOAD, Remedy.RECOVER, _RESET),
        0x0F: FaultCode("automatic release completed", FaultClass.SAFETY_STOP, Remedy.RECOVER, _RESET),
    }
)
"""Fault codes; others are not documented."""


def encode_action(action: Action) -> tuple[int, int, int]:
    """Return the three output registers. Raises CodecError for a count outside 0 to 255."""
    for name in ("position", "speed", "force"):
        if not 0 <= getattr(action, name) <= COUNTS:
            raise CodecError(name, getattr(action, name), f"is not 0 to {COUNTS}")
    request = _ACTIVATE * action.activate | _GO * action.go
    return request << 8, action.position, action.speed << 8 | action.force


def decode_action(registers: tuple[int, int, int]) -> Action:
    """Decode the output registers; reserved bits are ignored."""
    request = registers[0] >> 8
    position, speed, force = registers[1] & 0xFF, registers[2] >> 8, registers[2] & 0xFF
    return Action(bool(request & _ACTIVATE), bool(request & _GO), position, speed, force)


def encode_status(status: Status) -> tuple[int, int, int]:
    """Return the three input registers, as a gripper sends them."""
    first = status.activated | status.going << 3 | status.activation << 4 | status.met << 6
    current = min(round(status.current_a / CURRENT_A), COUNTS)
    return first << 8, status.fault << 8 | status.requested, status.position << 8 | current


def decode_status(registers: tuple[int, ...]) -> Status:
    """Decode the input registers. Raises CodecError for a number of registers that is not three."""
    if len(registers) != REGISTERS:
        raise CodecError("status", len(registers), f"is not {REGISTERS} registers")
    first = registers[0] >> 8
    return Status(
        activated=bool(first & 1),
        going=bool(first & 8),
        activation=ActivationStatus(first >> 4 & 3),
        met=ObjectStatus(first >> 6),
        fault=registers[1] >> 8 & 0x0F,
        requested=registers[1] & 0xFF,
        position=registers[2] >> 8,
        current_a=(registers[2] & 0xFF) * CURRENT_A,
    )
