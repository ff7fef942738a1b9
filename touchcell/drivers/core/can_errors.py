"""Decode CAN error frames as defined in linux/can/error.h (classes in the id, details in the data)."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

CONTROLLER = 0x004
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100

CLASSES: Mapping[int, str] = MappingProxyType(
    {
        0x001: "transmit timeout",
        0x002: "lost arbitration",
        CONTROLLER: "controller problem",
        0x008: "protocol violation",
        0x010: "transceiver status",
        0x020: "no acknowledgement",
        BUS_OFF: "bus-off",
        BUS_ERROR: "bus error",
        RESTARTED: "controller restarted",
        0x200: "error counters changed",
    }
)

COUNTERS_CHANGED = 0x200
_PASSIVE = 0x30


def describe(arbitration_id: int) -> str:
    """Return the error classes of an error frame as text."""
    return ", ".join(name for bit, name in CLASSES.items() if arbitration_id & bit) or "unspecified error"


def counters(data: bytes) -> tuple[int, int]:
    """Return the transmit and receive error counters of an error frame (data bytes 6 and 7); 0 where it has none."""
    return (data[6], data[7]) if len(data) > 7 else (0, 0)


def is_error_passive(arbitration_id: int, data: bytes) -> bool:
    """Return whether the controller is error-passive (data byte 1, receiver or transmitter)."""
    return bool(arbitration_id & CONTROLLER) and len(data) > 1 and bool(data[1] & _PASSIVE)
