"""Wire format of Universal Robots' Real-Time Data Exchange (RTDE), version 2: pure functions, no I/O.

Every packet is ``u16 size, u8 type, payload``, big-endian, size counting itself. A client negotiates the version, sets
up the variables it wants to read (one output recipe) and to write (input recipes), then starts the stream of data
packets, each ``u8 recipe, values``. RTDE has no checksum of its own (TCP has): a corrupt packet is detected only by its
size, type, recipe or value. Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", for e-Series PolyScope 5.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from touchcell.drivers.core.errors import CorruptMessage

PORT = 30004
PROTOCOL_VERSION = 2
NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"
HEADER_SIZE = 3

Value = float | int | bool | tuple[float, ...] | tuple[int, ...]

_FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

TYPE_NAMES = frozenset(_FORMATS)
"""Data types that a recipe may name."""
"""Data types of RTDE variables."""


class PacketType(IntEnum):
    """Type byte of a packet."""

    REQUEST_PROTOCOL_VERSION = 86
    GET_URCONTROL_VERSION = 118
    TEXT_MESSAGE = 77
    DATA = 85
    SETUP_OUTPUTS = 79
    SETUP_INPUTS = 73
    START = 83
    PAUSE = 80


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet without its size."""

    kind: PacketType
    payload: bytes = b""


def encode(packet: Packet) -> bytes:
    """Return the bytes of ``packet``. Raises CorruptMessage if it is too long for its size field."""
    size = HEADER_SIZE + len(packet.payload)
    if size > 0xFFFF:
        raise CorruptMessage("rtde", f"packet of {size} bytes does not fit")
    return struct.pack(">HB", size, packet.kind) + packet.payload


def split(stream: bytes) -> tuple[list[Packet], bytes]:
    """Return the complete packets at the front of ``stream`` and the remaining bytes.

    Raises:
        CorruptMessage: a size below the header's or an unknown type; the stream cannot be resynchronised.
    """
    packets = []
    start = 0
    while len(stream) - start >= HEADER_SIZE:
        size, kind = struct.unpack_from(">HB", stream, start)
        if size < HEADER_SIZE:
            raise CorruptMessage("rtde", f"packet claims {size} bytes")
        try:
            packet_type = PacketType(kind)
        except ValueError:
            raise CorruptMessage("rtde", f"unknown packet type {kind}") from None
        if len(stream) - start < size:
            break
        packets.append(Packet(packet_type, stream[start + HEADER_SIZE : start + size]))
        start += size
    return packets, stream[start:]


@dataclass(frozen=True, slots=True)
class Recipe:
    """Variables transmitted together in one data packet.

    Attributes:
        number: recipe number, 1 to 255; 0 marks a rejected recipe.
        names: names of the variables.
        types: data types, one per name.
    """

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]
    _layout: struct.Struct = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        unknown = [name for name in self.types if name not in TYPE_NAMES]
        if unknown or len(self.names) != len(self.types) or not 0 < self.number <= 0xFF:
            raise CorruptMessage("rtde", f"bad recipe: number {self.number}, {len(self.names)} names, types {unknown}")
        object.__setattr__(self, "_layout", struct.Struct(">B" + "".join(_FORMATS[name] for name in self.types)))

    def pack(self, values: Mapping[str, Value]) -> bytes:
        """Encode a data packet's payload. Raises CorruptMessage for a missing variable or a value out of range."""
        flat: list[float | int | bool] = [self.number]
        try:
            for name in self.names:
                value = values[name]
                if isinstance(value, tuple):
                    flat.extend(value)
                else:
                    flat.append(value)
            return self._layout.pack(*flat)
        except (KeyError, struct.error) as error:
            raise CorruptMessage("rtde", f"recipe {self.number} does not fit: {error}") from None

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Decode a data packet into values by name. Raises CorruptMessage for another recipe or size."""
        if len(payload) != self._layout.size or payload[0] != self.number:
            raise CorruptMessage("rtde", f"{len(payload)} bytes do not match recipe {self.number}")
        flat = self._layout.unpack(payload)[1:]
        values: dict[str, Value] = {}
        at = 0
        for name, kind in zip(self.names, self.types, strict=True):
            digits = _FORMATS[kind][:-1]
            count = int(digits) if digits else 1
            values[name] = flat[at] if not digits else flat[at : at + count]
            at += count
        return values


def version_request() -> Packet:
    """Request protocol version 2."""
    return Packet(PacketType.REQUEST_PROTOCOL_VERSION, struct.pack(">H", PROTOCOL_VERSION))


def parse_version_request(payload: bytes) -> int:
    """Return the requested version. Raises CorruptMessage."""
    return int(_unpack(">H", payload, "version request")[0])


def accepted(kind: PacketType, yes: bool) -> Packet:
    """Build the reply to a version request, a start or a pause."""
    return Packet(kind, bytes([yes]))


def parse_accepted(payload: bytes) -> bool:
    """Return whether the request was accepted. Raises CorruptMessage."""
    return bool(_unpack(">?", payload, "answer")[0])


def controller_version(major: int, minor: int, bugfix: int, build: int) -> Packet:
    """Build the packet with the version of the controller's software."""
    return Packet(PacketType.GET_URCONTROL_VERSION, struct.pack(">4I", major, minor, bugfix, build))


def parse_controller_version(payload: bytes) -> tuple[int, int, int, int]:
    """Return major, minor, bugfix, build. Raises CorruptMessage."""
    major, minor, bugfix, build = _unpack(">4I", payload, "controller version")
    return int(major), int(minor), int(bugfix), int(build)


def setup_outputs(rate_hz: float, names: Sequence[str]) -> Packet:
    """Request the output variables ``names`` at ``rate_hz``."""
    return Packet(PacketType.SETUP_OUTPUTS, struct.pack(">d", rate_hz) + ",".join(names).encode())


def parse_setup_outputs(payload: bytes) -> tuple[float, tuple[str, ...]]:
    """Return rate in Hz and names. Raises CorruptMessage for a rate outside [1, 500] (NaN too) or undecodable names."""
    if len(payload) < 8:
        raise CorruptMessage("rtde", "output setup without a rate")
    (rate_hz,) = struct.unpack_from(">d", payload)
    if not 1.0 <= rate_hz <= 500.0:
        raise CorruptMessage("rtde", f"rate {rate_hz} Hz")
    return rate_hz, parse_names(payload[8:])


def setup_inputs(names: Sequence[str]) -> Packet:
    """Declare the input variables ``names``, which will be written together."""
    return Packet(PacketType.SETUP_INPUTS, ",".join(names).encode())


def parse_names(payload: bytes) -> tuple[str, ...]:
    """Return comma-separated names; a trailing comma is customary. Raises CorruptMessage."""
    try:
        return tuple(name for name in payload.decode("ascii").split(",") if name)
    except UnicodeDecodeError:
        raise CorruptMessage("rtde", "names are not text") from None


def recipe_answer(kind: PacketType, number: int, types: Sequence[str]) -> Packet:
    """Build the reply to a setup: the recipe's number, and each variable's type, NOT_FOUND or IN_USE."""
    return Packet(kind, bytes([number]) + ",".join(types).encode())


def parse_recipe_answer(payload: bytes, names: Sequence[str]) -> Recipe:
    """Return the recipe granted for ``names``. Raises CorruptMessage if any variable was rejected."""
    if not payload:
        raise CorruptMessage("rtde", "empty reply to a setup")
    return Recipe(payload[0], tuple(names), parse_names(payload[1:]))


def _unpack(layout: str, payload: bytes, what: str) -> tuple[int | float | bool, ...]:
    if len(payload) != struct.calcsize(layout):
        raise CorruptMessage("rtde", f"{what} of {len(payload)} bytes")
    return struct.unpack(layout, payload)
