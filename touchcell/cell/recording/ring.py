"""A ring of messages in a file of fixed size that outlives its writer: a kill, a crash, a full disk.

The file's blocks are allocated before the first message, and messages are handed to the kernel as they are added, those
of a control cycle in one call: what was added is in the file whatever becomes of the process, and no message needs room
on the disk. (Writing through a mapping would be as lasting, but ends the process by SIGBUS where the file is truncated
or its blocks are copied on write.)

The ring is a row of segments. Records follow each other within a segment, each with a running number and a checksum; a
reader takes a segment's records as long as both fit, so neither torn records nor those of an earlier round are read.
Before the segments are the types of the messages, which are never overwritten. Rings of 0.2.0, whose messages are JSON
and have no types, are read as well.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from google.protobuf.message import DecodeError

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Message
from touchcell.cell.recording.message_types import Encoded, MessageType, UnreadableType, decoder, message_class

_MAGIC: Final = b"tchring2"
_MAGIC_OF_JSON: Final = b"tchring1"
_HEAD: Final = struct.Struct("<8sIIII")
_HEAD_BYTES: Final = 4096
_CHECK: Final = struct.Struct("<I")
_BODY: Final = struct.Struct("<IQqH")
_RECORD: Final = struct.Struct("<IIQqH")
"""A check of what follows, and the head of that."""
_TYPE: Final = struct.Struct("<IHI")
_TYPES_BYTES: Final = 256 * 1024
_NUMBER: Final = struct.Struct("<H")
_SEGMENTS: Final = 16
_LEAST_SEGMENT: Final = 16 * 1024
_LONGEST_TOPIC: Final = 0xFFFF
_SEGMENTS_AT: Final = _HEAD_BYTES + _TYPES_BYTES


class RingWriter:
    """Writes a ring, which is made anew.

    Args:
        path: the file; None keeps the ring in this process's memory only.
        size: bytes of all segments; less, down to 256 KiB, where the disk has not four times as much.
        about: what the ring is of, up to about 4000 bytes of JSON.

    Raises:
        RecordingError: the file cannot be made, or the disk has no room for it.
    """

    def __init__(self, path: Path | None, size: int, about: Mapping[str, Any]) -> None:
        self.path = path
        self._number = 0
        self._segment = self._at = 0
        self._types: list[MessageType] = []
        self._numbers: dict[int, int] = {}
        self._types_at = 0
        self._headings: dict[tuple[str, int], tuple[int, bytes]] = {}
        self._failed = False
        try:
            if path is None:
                self._fd = os.memfd_create("touchcell-ring", os.MFD_CLOEXEC)
            else:
                self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
                disk = os.fstatvfs(self._fd)
                size = min(size, disk.f_bavail * disk.f_frsize // 4)
            self._segment_bytes = max(size // _SEGMENTS, _LEAST_SEGMENT)
            os.posix_fallocate(self._fd, 0, _SEGMENTS_AT + _SEGMENTS * self._segment_bytes)
            text = json.dumps(about, default=str).encode()[: _HEAD_BYTES - _HEAD.size]
            head = _HEAD.pack(_MAGIC, _SEGMENTS, self._segment_bytes, len(text), zlib.crc32(text))
            os.pwrite(self._fd, head + text, 0)
        except OSError as error:
            raise RecordingError(
                path or Path("memory"), f"cannot be made: {error.strerror}", hint="free some space"
            ) from None

    @property
    def failed(self) -> bool:
        """Whether a write has failed; nothing more is written then."""
        return self._failed

    def add(self, messages: Iterable[tuple[str, int, Encoded]]) -> None:
        """Append topics, stamps and messages, in one call of the kernel for each segment that they reach.

        One that is longer than a segment, or comes after a failure, is left out.
        """
        at, pieces = self._at, list[bytes]()
        for topic, t_ns, message in messages:
            heading = self._headings.get((topic, id(message.type)))
            if heading is None:
                heading = self._heading(topic, message.type)
                if heading is None:
                    continue
            name_length, name = heading
            data = message.data
            length = len(name) + len(data)
            whole = _RECORD.size + length
            if self._failed or whole > self._segment_bytes:
                continue
            if self._at + whole > self._segment_bytes:
                self._put(at, pieces)
                self._segment, self._at = (self._segment + 1) % _SEGMENTS, 0
                at, pieces = 0, []
            self._number += 1
            body = b"".join((_BODY.pack(length, self._number, t_ns, name_length), name, data))
            pieces += (_CHECK.pack(zlib.crc32(body)), body)
            self._at += whole
        self._put(at, pieces)

    def _put(self, at: int, pieces: list[bytes]) -> None:
        if not pieces:
            return
        try:
            os.pwrite(self._fd, b"".join(pieces), _SEGMENTS_AT + self._segment * self._segment_bytes + at)
        except OSError:
            self._failed = True

    def _heading(self, topic: str, type_: MessageType) -> tuple[int, bytes] | None:
        """Return the length of a topic's name, and the name with the number of the type; None without room for that."""
        number = self._numbers.get(id(type_))
        if number is None:
            number = self._describe(type_)
            if number is None:
                return None
        name = topic.encode()[:_LONGEST_TOPIC]
        self._headings[topic, id(type_)] = found = len(name), name + _NUMBER.pack(number)
        return found

    def _describe(self, type_: MessageType) -> int | None:
        """Keep a type; None where there is no room for it."""
        body = type_.full_name.encode() + b"\0" + type_.schema
        entry = _TYPE.pack(zlib.crc32(body), len(self._types), len(body)) + body
        if self._types_at + len(entry) > _TYPES_BYTES:
            return None
        try:
            os.pwrite(self._fd, entry, _HEAD_BYTES + self._types_at)
        except OSError:
            self._failed = True
            return None
        self._types_at += len(entry)
        # The list keeps the type alive, whose identity is the key.
        self._numbers[id(type_)] = len(self._types)
        self._types.append(type_)
        return len(self._types) - 1

    def sync(self) -> None:
        """Have the disk keep it, for the case that the power fails too."""
        if self.path is not None and not self._failed:
            try:
                os.fdatasync(self._fd)
            except OSError:
                self._failed = True

    def messages(self) -> list[Message]:
        """What is in it, oldest first."""
        return _messages(self._fd, _SEGMENTS_AT, _SEGMENTS, self._segment_bytes, _typed(self._fd))

    def close(self) -> None:
        """Let go of the file, which stays; again does nothing."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


def read_ring(path: Path) -> tuple[dict[str, Any], list[Message]]:
    """What a ring is of, and its messages, oldest first.

    Raises:
        RecordingError: ``path`` is missing or no ring.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from None
    try:
        head = os.pread(fd, _HEAD_BYTES, 0)
        if len(head) < _HEAD.size or head[: len(_MAGIC)] not in (_MAGIC, _MAGIC_OF_JSON):
            raise RecordingError(path, "is no black box")
        _, segments, segment_bytes, length, check = _HEAD.unpack_from(head)
        text = head[_HEAD.size : _HEAD.size + length]
        about = _parsed(text) if zlib.crc32(text) == check else None
        typed = head.startswith(_MAGIC)
        segments_at = _SEGMENTS_AT if typed else _HEAD_BYTES
        if segments_at - _HEAD_BYTES + segments * segment_bytes > os.fstat(fd).st_size:
            raise RecordingError(path, "is damaged: its head does not fit its size")
        return about or {}, _messages(fd, segments_at, segments, segment_bytes, _typed(fd) if typed else _parsed)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from None
    finally:
        os.close(fd)


def _messages(
    fd: int,
    segments_at: int,
    segments: int,
    segment_bytes: int,
    decode: Callable[[bytes], dict[str, Any] | None],
) -> list[Message]:
    found: list[tuple[int, Message]] = []
    for k in range(segments):
        segment = os.pread(fd, segment_bytes, segments_at + k * segment_bytes)
        at, expected = 0, None
        while at + _RECORD.size <= len(segment):
            check, length, number, t_ns, name_length = _RECORD.unpack_from(segment, at)
            end = at + _RECORD.size + length
            if end > len(segment) or name_length > length or number != (expected or number) or number == 0:
                break
            if zlib.crc32(segment[at + 4 : end]) != check:
                break
            name, data = segment[at + _RECORD.size :][:name_length], segment[at + _RECORD.size + name_length : end]
            message = decode(data)
            if message is not None:
                found.append((number, Message(name.decode(errors="replace"), t_ns, message)))
            at, expected = end, number + 1
    return [message for _, message in sorted(found, key=lambda each: each[0])]


def _typed(fd: int) -> Callable[[bytes], dict[str, Any] | None]:
    """Return what decodes the messages of a ring by the types that it holds; None for what cannot be read."""
    area = os.pread(fd, _TYPES_BYTES, _HEAD_BYTES)
    readers: dict[int, Callable[[bytes], dict[str, Any]]] = {}
    at = 0
    while at + _TYPE.size <= len(area):
        check, number, length = _TYPE.unpack_from(area, at)
        body = area[at + _TYPE.size : at + _TYPE.size + length]
        at += _TYPE.size + length
        if not length or zlib.crc32(body) != check:
            break
        name, _, schema = body.partition(b"\0")
        try:
            readers[number] = decoder(message_class(name.decode(errors="replace"), schema))
        except UnreadableType:
            continue

    def decode(data: bytes) -> dict[str, Any] | None:
        try:
            return readers[_NUMBER.unpack_from(data)[0]](data[_NUMBER.size :])
        except (KeyError, struct.error, DecodeError, ValueError, RecursionError):
            return None

    return decode


def _parsed(data: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
