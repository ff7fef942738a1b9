"""CAN messages as packets of a local socket, in SocketCAN's layout.

One packet is one frame: ``struct can_frame`` (16 bytes) or ``struct canfd_frame`` (72 bytes), so that its order and its
boundaries are the kernel's (linux/can.h).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import can

LONGEST: Final = 128
"""More than any packet has."""

_CLASSIC = struct.Struct("=IB3x8s")
_FD = struct.Struct("=IBB2x64s")
FRAME_SIZES: Final = frozenset((_CLASSIC.size, _FD.size))
"""Sizes of the packets that are frames."""
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_BIT_RATE_SWITCH, _FD_FRAME = 0x01, 0x04


def pack(message: can.Message) -> bytes:
    """Encode a message in SocketCAN's layout."""
    number = message.arbitration_id
    number |= _EXTENDED if message.is_extended_id else 0
    number |= _REMOTE if message.is_remote_frame else 0
    number |= _ERROR if message.is_error_frame else 0
    data = bytes(message.data)
    if message.is_fd:
        flags = _FD_FRAME | (_BIT_RATE_SWITCH if message.bitrate_switch else 0)
        return _FD.pack(number, len(data), flags, data)
    return _CLASSIC.pack(number, message.dlc, data)


def unpack(packet: bytes, timestamp_s: float = 0.0) -> can.Message:
    """Decode a packet of ``pack``. Raises ValueError for a packet of another size or with an impossible length."""
    import can

    if len(packet) == _CLASSIC.size:
        (number, length, data), flags, longest = _CLASSIC.unpack(packet), 0, 8
    elif len(packet) == _FD.size:
        number, length, flags, data = _FD.unpack(packet)
        longest = 64
    else:
        raise ValueError(f"a packet of {len(packet)} bytes is not a CAN frame")
    if length > longest:
        raise ValueError(f"a frame cannot carry {length} bytes")
    is_remote = bool(number & _REMOTE)
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=number & 0x1FFFFFFF,
        is_extended_id=bool(number & _EXTENDED),
        is_remote_frame=is_remote,
        is_error_frame=bool(number & _ERROR),
        is_fd=len(packet) == _FD.size,
        bitrate_switch=bool(flags & _BIT_RATE_SWITCH),
        dlc=length,
        data=None if is_remote else data[:length],
        check=True,
    )
