"""Reader of MCAP recordings, also of those that were cut off or damaged: it takes what is whole and names the rest.

Messages of this package's own types, images, video and joint states come back as mappings; those that only repeat them
for viewers are left out. Recordings of 0.1.0 and 0.2.0, whose messages are JSON, are read as well.
"""

from __future__ import annotations

import json
import logging
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

import lz4.frame
import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema, Statistics

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.message_types import PACKAGE, UnreadableType, decoder, message_class

RECORDING: Final = "run.mcap"
"""Name of the recording in a run folder."""
CELL_CLOCK: Final = "cell_clock_offset_ns"
"""Key in the metadata of a channel: wall clock minus the cell's clock, which its stamps contain."""
READ_AS_WELL: Final = frozenset({"foxglove.CompressedImage", "foxglove.CompressedVideo", "foxglove.JointStates"})
"""Types of viewers that are read as well: what they hold is in no other message."""

_log = logging.getLogger(__name__)

_BLOCK_BYTES: Final = 1 << 20
_MAGIC: Final = b"\x89MCAP0\r\n"
_RECORD_HEAD: Final = 9
_LAST_KIND: Final = int(max(Opcode))
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
# What the parsers of records raise for bytes that are none; an overflow for lengths beyond all memory.
_UNREADABLE: Final = (McapError, struct.error, UnicodeDecodeError, OverflowError, MemoryError)
_LONGEST_RECORD: Final = 1 << 28
_LONGEST_CHUNK: Final = 1 << 26
# Of a chunk beyond a usual one's size: what expands more is no recording but a trap.
_MOST_EXPANSION: Final = 50
_USUAL_CHUNK: Final = 1 << 20
# A chunk's compression, as a prefixed string, and how far it is behind the chunk's first byte.
_CHUNK_MARK: Final = re.compile(rb"\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd")
_LONGEST_MARK: Final = 8
_CHUNK_MARK_AT: Final = _RECORD_HEAD + 8 + 8 + 8 + 4


@dataclass(frozen=True, slots=True)
class Message:
    """One recorded message."""

    topic: str
    t_ns: int
    data: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Damage:
    """Something in a recording that could not be read: where in the file, and what is wrong with it."""

    offset: int
    reason: str

    def __str__(self) -> str:
        return f"at byte {self.offset}: {self.reason}"


def read(path: Path, damage: list[Damage] | None = None) -> Iterator[Message]:
    """All undamaged messages of a recording in file order, also of one whose writer was killed.

    Args:
        path: the recording.
        damage: gets what could not be read; without it, that is logged.

    Raises:
        RecordingError: ``path`` is missing or not an MCAP file.
    """
    found: list[Damage] = [] if damage is None else damage
    with _opened(path) as stream:
        if (magic := stream.read(len(_MAGIC))) != _MAGIC:
            empty = _MAGIC.startswith(magic)
            raise RecordingError(
                path, "is empty: its writer ended before anything was written" if empty else "is not an MCAP file"
            )
        yield from _Reader(stream, lambda: False, found).messages()
    if damage is None:
        for each in found:
            _log.warning("%s: %s", path, each)


def follow(path: Path, wait: Callable[[], bool]) -> Iterator[Message]:
    """Yield all messages of a recording that may still be written, and those added to it, until it is finished.

    Args:
        path: the recording.
        wait: called when there is nothing new; returns False to stop waiting.

    Raises:
        RecordingError: ``path`` is missing or not an MCAP file.
    """
    found: list[Damage] = []
    with _opened(path) as stream:
        reader = _Reader(stream, wait, found)
        magic = reader.bytes_at(0, len(_MAGIC))
        if magic is None:
            return
        if magic != _MAGIC:
            raise RecordingError(path, "is not an MCAP file")
        yield from reader.messages()


def _opened(path: Path) -> IO[bytes]:
    try:
        if not path.is_file():
            raise RecordingError(path, "cannot be read: no such file")
        return path.open("rb")
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from None


def wall_clock_offset_ns(path: Path) -> int:
    """Return wall clock minus the cell's clock of a recording, whole or not; 0 where nothing says it.

    Raises:
        RecordingError: ``path`` cannot be read.
    """
    with _opened(path) as stream:
        stream.seek(len(_MAGIC))
        reader = _Reader(stream, lambda: False, [])
        next(reader.messages(), None)
        return next((channel.offset_ns for channel in reader.channels), 0)


class _Damaged(Exception):
    """Bytes that are not what they should be."""


@dataclass(frozen=True, slots=True)
class _Channel:
    """How to read the messages of a channel.

    Attributes:
        topic: of the messages.
        offset_ns: to subtract from their stamps.
        read: function from bytes to fields; None for messages that only viewers read.
    """

    topic: str
    offset_ns: int
    read: Callable[[bytes], dict[str, Any]] | None


class _Reader:
    """Reads records one by one, verifies the checksum of each chunk, and finds the next chunk behind damage.

    Args:
        stream: can be seeked.
        wait: called when the file ends early; returns whether to try again.
        damage: gets what could not be read.
    """

    def __init__(self, stream: IO[bytes], wait: Callable[[], bool], damage: list[Damage]) -> None:
        self._stream = stream
        self._wait = wait
        self._damage = damage
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, _Channel] = {}
        self._searched = False
        self._delivered = 0
        self._promised: int | None = None

    @property
    def channels(self) -> list[_Channel]:
        """The channels that were described so far."""
        return list(self._channels.values())

    def bytes_at(self, offset: int, count: int) -> bytes | None:
        """``count`` bytes at ``offset``; None if the file ends before and nothing more comes."""
        while True:
            self._stream.seek(offset)
            found = self._stream.read(count)
            if len(found) == count:
                return found
            if not self._wait():
                return None

    def messages(self) -> Iterator[Message]:
        """Every message that is whole."""
        offset = len(_MAGIC)
        while True:
            head = self.bytes_at(offset, _RECORD_HEAD)
            if head is None:
                self._note(offset, "is cut off: its writer was killed, or the disk filled up")
                return
            kind, length = head[0], int.from_bytes(head[1:], "little")
            content = None
            if 0 < kind <= _LAST_KIND and length <= _LONGEST_RECORD:
                content = self.bytes_at(offset + _RECORD_HEAD, length)
            if content is None:
                behind = self._next_chunk(offset + 1)
                if behind is None:
                    self._note(offset, "is cut off in the middle of a record, or damaged from there on")
                    return
                self._note(offset, f"{behind - offset} bytes are damaged")
                offset = behind
                continue
            if kind == Opcode.FOOTER:
                self._compare()
                return
            try:
                yield from self._record(kind, content, offset)
            except _Damaged as error:
                self._note(offset, str(error))
            offset += _RECORD_HEAD + length

    def _record(self, kind: int, content: bytes, offset: int) -> Iterator[Message]:
        try:
            if kind == Opcode.CHUNK:
                yield from self._chunk(content, offset)
            elif kind in (Opcode.CHANNEL, Opcode.SCHEMA):
                self._register(kind, content)
            elif kind == Opcode.MESSAGE:
                yield from self._message(content, offset)
            elif kind == Opcode.STATISTICS:
                self._promised = Statistics.read(ReadDataStream(BytesIO(content))).message_count
        except _UNREADABLE as error:
            raise _Damaged(f"a record is damaged: {error or type(error).__name__}") from None

    def _chunk(self, content: bytes, offset: int) -> Iterator[Message]:
        data = _unpacked(Chunk.read(ReadDataStream(BytesIO(content))))
        at = 0
        while at < len(data):
            kind, end = data[at], at + _RECORD_HEAD + int.from_bytes(data[at + 1 : at + _RECORD_HEAD], "little")
            record = data[at + _RECORD_HEAD : end]
            if end > len(data):
                raise _Damaged("a chunk ends in the middle of a record")
            if kind in (Opcode.CHANNEL, Opcode.SCHEMA):
                self._register(kind, record)
            elif kind == Opcode.MESSAGE:
                try:
                    yield from self._message(record, offset)
                except _Damaged as error:
                    self._note(offset, str(error))
            at = end

    def _register(self, kind: int, content: bytes) -> None:
        if kind == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(content)))
            self._schemas[schema.id] = schema
            return
        channel = Channel.read(ReadDataStream(BytesIO(content)))
        try:
            offset_ns = int(channel.metadata.get(CELL_CLOCK, 0))
            self._channels[channel.id] = _Channel(channel.topic, offset_ns, self._reader(channel))
        except (UnreadableType, ValueError) as error:
            raise _Damaged(f"the description of {channel.topic} is damaged: {error}") from None

    def _reader(self, channel: Channel) -> Callable[[bytes], dict[str, Any]] | None:
        if channel.message_encoding == "json":
            return _json
        if channel.message_encoding != "protobuf":
            return None
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            raise UnreadableType(f"schema {channel.schema_id} is missing")
        if schema.name.startswith(f"{PACKAGE}.") or schema.name in READ_AS_WELL:
            return decoder(message_class(schema.name, schema.data))
        return None

    def _message(self, content: bytes, offset: int) -> Iterator[Message]:
        if len(content) < _MESSAGE_HEAD.size:
            raise _Damaged("a message is too short")
        number, _, t_ns, _ = _MESSAGE_HEAD.unpack_from(content)
        channel = self._channels.get(number)
        if channel is None and not self._searched:
            self._searched = True
            self._search_topics(offset)
            channel = self._channels.get(number)
        if channel is None:
            raise _Damaged(f"a message is of channel {number}, which nothing describes")
        if channel.read is not None:
            try:
                data = channel.read(content[_MESSAGE_HEAD.size :])
            except (ValueError, RecursionError, DecodeError):
                raise _Damaged(f"a message of {channel.topic} cannot be read") from None
            self._delivered += 1
            yield Message(channel.topic, t_ns - channel.offset_ns, data)
        else:
            self._delivered += 1

    def _search_topics(self, offset: int) -> None:
        """Find channels whose first description was damaged: the summary at the end of a finished file repeats all."""
        while True:
            self._stream.seek(offset)
            head = self._stream.read(_RECORD_HEAD)
            length = int.from_bytes(head[1:], "little")
            if len(head) < _RECORD_HEAD or length > _LONGEST_RECORD or head[0] == Opcode.FOOTER:
                return
            if head[0] in (Opcode.CHANNEL, Opcode.SCHEMA):
                try:
                    self._register(head[0], self._stream.read(length))
                except (*_UNREADABLE, _Damaged):
                    return
            offset += _RECORD_HEAD + length

    def _next_chunk(self, offset: int) -> int | None:
        """Where the next chunk behind ``offset`` begins, found by the name of its compression."""
        overlap = b""
        self._stream.seek(offset)
        at = offset
        while block := self._stream.read(_BLOCK_BYTES):
            held = overlap + block
            for mark in _CHUNK_MARK.finditer(held):
                start = at - len(overlap) + mark.start() - _CHUNK_MARK_AT
                if start >= offset and self._is_kind(start, Opcode.CHUNK):
                    return start
            at += len(block)
            overlap = held[1 - _LONGEST_MARK :]
            self._stream.seek(at)
        return None

    def _is_kind(self, offset: int, kind: int) -> bool:
        self._stream.seek(offset)
        head = self._stream.read(_RECORD_HEAD)
        return len(head) == _RECORD_HEAD and head[0] == kind and int.from_bytes(head[1:], "little") <= _LONGEST_RECORD

    def _compare(self) -> None:
        """Name what is missing although nothing that was read looked damaged."""
        if self._promised is not None and self._promised != self._delivered and not self._damage:
            self._note(0, f"{self._delivered} of {self._promised} messages are there")

    def _note(self, offset: int, reason: str) -> None:
        self._damage.append(Damage(offset, reason))


def _json(content: bytes) -> dict[str, Any]:
    data = json.loads(content)
    if not isinstance(data, dict):
        raise ValueError("no JSON object")
    return data


def _unpacked(chunk: Chunk) -> bytes:
    """The records in a chunk, no longer than it says and no more often what is in the file than a recording can be."""
    size = chunk.uncompressed_size
    if size > _LONGEST_CHUNK or size > _MOST_EXPANSION * len(chunk.data) + _USUAL_CHUNK:
        raise _Damaged(f"a chunk of {len(chunk.data)} bytes claims to hold {size}")
    try:
        if chunk.compression == "lz4":
            data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        elif chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(BytesIO(chunk.data)).read(size + 1)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise _Damaged(f"a chunk is compressed by {chunk.compression!r}, which is unknown")
    except (RuntimeError, ValueError, EOFError, MemoryError, zstandard.ZstdError):
        raise _Damaged("a chunk cannot be decompressed") from None
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise _Damaged(f"the checksum of a chunk of {size} bytes is wrong")
    return data
