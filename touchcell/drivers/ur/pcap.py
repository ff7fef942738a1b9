"""Captures of a network: what each side of a TCP connection sent, in order and with times.

Reads pcap and pcapng files with Ethernet, Linux cooked, loopback and raw IPv4 frames, which is what tcpdump and
Wireshark write. Sources: IETF draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng; RFC 791, RFC 9293.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from touchcell.errors import ConfigError

_ETHERNET, _RAW, _COOKED, _COOKED_2, _NULL = 1, 101, 113, 276, 0
_LINK_HEADER: Final = {_ETHERNET: 14, _RAW: 0, _COOKED: 16, _COOKED_2: 20, _NULL: 4, 12: 0}
_VLAN, _TCP, _IPV4 = 0x8100, 6, 4
_SYN = 0x02
_WRAP = 1 << 32


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of a stream: number of its frame in the file from 1, time in s, the bytes."""

    frame: int
    t_s: float
    data: bytes


@dataclass(slots=True)
class Connection:
    """A TCP connection to a port: what the client and the server sent."""

    client: list[Segment] = field(default_factory=list)
    server: list[Segment] = field(default_factory=list)


@dataclass(slots=True)
class _Direction:
    """Order of the bytes of one direction."""

    following: int | None = None
    early: dict[int, Segment] = field(default_factory=dict)

    def take(self, sequence: int, segment: Segment) -> Iterator[Segment]:
        """Yield what can be put into order now; a repeated segment yields nothing."""
        if self.following is None:
            self.following = sequence
        self.early.setdefault(sequence, segment)
        while (piece := self._next()) is not None:
            yield piece

    def _next(self) -> Segment | None:
        assert self.following is not None
        for sequence in list(self.early):
            ahead = (sequence - self.following) % _WRAP
            overlap = (self.following - sequence) % _WRAP
            if ahead == 0 or overlap < len(self.early[sequence].data):
                segment = self.early.pop(sequence)
                fresh = segment.data if ahead == 0 else segment.data[overlap:]
                self.following = (self.following + len(fresh)) % _WRAP
                return Segment(segment.frame, segment.t_s, fresh)
            if ahead > _WRAP // 2:
                del self.early[sequence]
        return None


def connections(path: Path, port: int) -> list[Connection]:
    """Return the connections to ``port`` in a file, in the order of their beginning. Raises ConfigError."""
    found: dict[tuple[bytes, bytes, int], Connection] = {}
    order: dict[tuple[bytes, bytes, int, bool], _Direction] = {}
    done: list[Connection] = []
    for number, (t_s, packet) in enumerate(_ip_packets(path), start=1):
        tcp = _tcp(packet)
        if tcp is None or port not in (tcp[2], tcp[3]):
            continue
        source, target, source_port, target_port, sequence, flags, data = tcp
        from_client = target_port == port
        key = (source, target, source_port) if from_client else (target, source, target_port)
        if flags & _SYN:
            if from_client:
                # A port that is used again is another connection.
                found.pop(key, None)
            order[(*key, from_client)] = _Direction((sequence + 1) % _WRAP)
            continue
        if not data:
            continue
        if key not in found:
            found[key] = Connection()
            done.append(found[key])
        direction = order.setdefault((*key, from_client), _Direction())
        stream = found[key].client if from_client else found[key].server
        stream.extend(direction.take(sequence, Segment(number, t_s, data)))
    return done


def _tcp(packet: bytes) -> tuple[bytes, bytes, int, int, int, int, bytes] | None:
    """Return addresses, ports, sequence number, flags and payload of an IPv4 packet; None for another one."""
    if len(packet) < 20 or packet[0] >> 4 != _IPV4 or packet[9] != _TCP:
        return None
    length = struct.unpack_from(">H", packet, 2)[0] or len(packet)
    ip_header = (packet[0] & 0xF) * 4
    segment = packet[ip_header:length]
    if len(segment) < 20:
        return None
    source_port, target_port, sequence = struct.unpack_from(">HHI", segment)
    return (
        packet[12:16],
        packet[16:20],
        source_port,
        target_port,
        sequence,
        segment[13],
        segment[(segment[12] >> 4) * 4 :],
    )


def _ip_packets(path: Path) -> Iterator[tuple[float, bytes]]:
    try:
        data = path.read_bytes()
        for link, t_s, frame in _frames(data):
            header = _LINK_HEADER[link]
            if link == _ETHERNET and frame[12:14] == struct.pack(">H", _VLAN):
                header += 4
            yield t_s, frame[header:]
    except (OSError, struct.error, KeyError, IndexError) as error:
        raise ConfigError(
            f"is no capture of a network: {error!r}",
            file=str(path),
            hint="record one with `tcpdump -i any -w session.pcap tcp port 30004`",
        ) from None


def _frames(data: bytes) -> Iterator[tuple[int, float, bytes]]:
    """Yield link type, time in s and bytes of each frame."""
    magic = data[:4]
    for order in "<>":
        for number, unit_s in ((0xA1B2C3D4, 1e-6), (0xA1B23C4D, 1e-9)):
            if magic == struct.pack(order + "I", number):
                yield from _classic(data, order, unit_s)
                return
    if magic != b"\x0a\x0d\x0d\x0a":
        raise KeyError("neither pcap nor pcapng")
    yield from _next_generation(data)


def _classic(data: bytes, order: str, unit_s: float) -> Iterator[tuple[int, float, bytes]]:
    link = struct.unpack_from(order + "I", data, 20)[0] & 0xFFFF
    at = 24
    # A capture that was cut off ends in the middle of a frame.
    while at + 16 <= len(data):
        seconds, fraction, length, _ = struct.unpack_from(order + "4I", data, at)
        yield link, seconds + unit_s * fraction, data[at + 16 : at + 16 + length]
        at += 16 + length


def _next_generation(data: bytes) -> Iterator[tuple[int, float, bytes]]:
    interfaces: list[tuple[int, float]] = []
    order, at = "<", 0
    while at + 12 <= len(data):
        if data[at : at + 4] == b"\x0a\x0d\x0d\x0a":
            order = "<" if data[at + 8 : at + 12] == struct.pack("<I", 0x1A2B3C4D) else ">"
            interfaces.clear()
        kind, length = struct.unpack_from(order + "II", data, at)
        if length < 12:
            raise KeyError("a block without a length")
        body = data[at + 8 : at + length - 4]
        if kind == 1:
            interfaces.append((struct.unpack_from(order + "H", body)[0], _resolution_s(body[8:], order)))
        elif kind == 6:
            number, high, low, size, _ = struct.unpack_from(order + "5I", body)
            link, unit_s = interfaces[number]
            yield link, unit_s * (high << 32 | low), body[20 : 20 + size]
        at += length


def _resolution_s(options: bytes, order: str) -> float:
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(order + "HH", options, at)
        if code == 9 and length:
            value = options[at + 4]
            return 2.0 ** -(value & 0x7F) if value & 0x80 else 10.0**-value
        if code == 0:
            break
        at += 4 + (length + 3) // 4 * 4
    return 1e-6
