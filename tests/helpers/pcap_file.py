"""Write captures of a TCP connection, as tcpdump does."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

_CLIENT, _SERVER = b"\x0a\x00\x00\x01", b"\x0a\x00\x00\x02"
_CLIENT_PORT = 50_000


def segment(t_s: float, sequence: int, from_client: bool, data: bytes, port: int, flags: int = 0x18) -> bytes:
    """Return one Ethernet frame with its record header."""
    ends = (_CLIENT, _SERVER) if from_client else (_SERVER, _CLIENT)
    ports = (_CLIENT_PORT, port) if from_client else (port, _CLIENT_PORT)
    tcp = struct.pack(">HHIIBBHHH", *ports, sequence & 0xFFFFFFFF, 0, 5 << 4, flags, 1000, 0, 0) + data
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(tcp), 0, 0, 64, 6, 0, *ends) + tcp
    frame = bytes(12) + b"\x08\x00" + ip
    return struct.pack("<4I", int(t_s), round(1e6 * (t_s % 1.0)), len(frame), len(frame)) + frame


def write(path: Path, pieces: Iterable[tuple[float, bool, bytes]], port: int) -> None:
    """Write a connection to ``port``: time in s, whether the client sent it, and the bytes."""
    frames = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    frames += [segment(0.0, 1000 * (2 - end) - 1, bool(end), b"", port, flags=0x02 if end else 0x12) for end in (1, 0)]
    at = {True: 1000, False: 2000}
    for t_s, from_client, data in pieces:
        frames.append(segment(t_s, at[from_client], from_client, data, port))
        at[from_client] += len(data)
    path.write_bytes(b"".join(frames))
