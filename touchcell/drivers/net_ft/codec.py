"""Messages of an ATI Net F/T box: Raw Data Transfer on UDP, and calibration information on TCP. Pure functions.

Source: ATI Industrial Automation, "Network Force/Torque Sensor System Manual" (9610-05-1022), UDP Interface Using RDT
and TCP Interface. All numbers are big-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.drivers.core.errors import CodecError
from touchcell.geometry.types import Array

RDT_PORT: Final = 49152
CALIBRATION_PORT: Final = 49151
_HEADER: Final = 0x1234
_START: Final = 2
_READ_CALIBRATION: Final = 1
_REQUEST: Final = struct.Struct(">HHI")
_RECORD: Final = struct.Struct(">IIIiiiiii")
_CALIBRATION: Final = struct.Struct(">HBBII6H")
CALIBRATION_LENGTH: Final = _CALIBRATION.size
_CALIBRATION_REQUEST_LENGTH: Final = 20
_NEWTONS: Final = {1: 4.4482216152605, 2: 1.0, 3: 4448.2216152605, 4: 1000.0, 5: 9.80665, 6: 0.00980665}
"""Force units by code: lbf, N, klbf, kN, kgf, gf."""
_NEWTON_METRES: Final = {1: 0.1129848290276167, 2: 1.3558179483314, 3: 1.0, 4: 1e-3, 5: 0.0980665, 6: 1000.0}
"""Torque units by code: lbf in, lbf ft, N m, N mm, kgf cm, kN m."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Scales of a sensor: one count in N, and in N m."""

    force_n: float
    torque_nm: float


@dataclass(frozen=True, slots=True)
class Record:
    """One sample.

    Attributes:
        number: internal sample number of the sensor, modulo 2^32.
        status: system status code; 0 is good.
        counts: (6,) forces and torques along the sensor's axes.
    """

    number: int
    status: int
    counts: Array


def request(count: int = 1) -> bytes:
    """Return the request for ``count`` records."""
    return _REQUEST.pack(_HEADER, _START, count)


def decode_request(data: bytes) -> tuple[int, int]:
    """Return command and count of a request. Raises CodecError."""
    if len(data) != _REQUEST.size:
        raise CodecError("request", data.hex(), f"has {len(data)} bytes, not {_REQUEST.size}")
    header, command, count = _REQUEST.unpack(data)
    if header != _HEADER:
        raise CodecError("header", hex(header), f"is not {_HEADER:#x}")
    return command, count


def encode_record(record: Record, rdt_number: int) -> bytes:
    """Return a record as the box sends it."""
    return _RECORD.pack(rdt_number, record.number, record.status, *(int(count) for count in record.counts))


def decode_record(data: bytes) -> Record:
    """Return the record in a datagram. Raises CodecError."""
    if len(data) != _RECORD.size:
        raise CodecError("record", data.hex(), f"has {len(data)} bytes, not {_RECORD.size}")
    _, number, status, *counts = _RECORD.unpack(data)
    return Record(number, status, np.array(counts, dtype=np.float64))


def calibration_request() -> bytes:
    """Return the request for the calibration."""
    return bytes([_READ_CALIBRATION]).ljust(_CALIBRATION_REQUEST_LENGTH, b"\0")


def encode_calibration(force_unit: int, torque_unit: int, counts_per_force: int, counts_per_torque: int) -> bytes:
    """Return the calibration as the box sends it."""
    return _CALIBRATION.pack(_HEADER, force_unit, torque_unit, counts_per_force, counts_per_torque, *([1] * 6))


def decode_calibration(data: bytes) -> Calibration:
    """Return the scales. Raises CodecError."""
    if len(data) != _CALIBRATION.size:
        raise CodecError("calibration", data.hex(), f"has {len(data)} bytes, not {_CALIBRATION.size}")
    header, force_unit, torque_unit, counts_per_force, counts_per_torque, *_ = _CALIBRATION.unpack(data)
    if header != _HEADER:
        raise CodecError("header", hex(header), f"is not {_HEADER:#x}")
    if force_unit not in _NEWTONS or torque_unit not in _NEWTON_METRES:
        raise CodecError("units", [force_unit, torque_unit], "are unknown")
    if not counts_per_force or not counts_per_torque:
        raise CodecError("counts per unit", [counts_per_force, counts_per_torque], "are not positive")
    return Calibration(_NEWTONS[force_unit] / counts_per_force, _NEWTON_METRES[torque_unit] / counts_per_torque)


def step(before: int, after: int) -> int:
    """Return how many samples ``after`` is ahead of ``before``, with the wrap at 2^32; negative if it is older."""
    return (after - before + 2**31) % 2**32 - 2**31
