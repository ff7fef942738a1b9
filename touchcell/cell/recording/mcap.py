"""MCAP recordings that survive a kill: small chunks, flushed as they close, and a reader that names damage.

Messages are JSON with a JSON schema, so that Foxglove and the ``mcap`` command line read them without touchcell.
"""

from __future__ import annotations

import json
import logging
import math
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Statistics
from mcap.writer import CompressionType, Writer

from touchcell.cell.errors import RecordingError

# A kill loses at most the open chunk: 16 KiB is a fraction of a second of a cell's usual 100 kB/s.
CHUNK_BYTES = 16 * 1024
RECORDING = "run.mcap"
"""Name of the recording in a run folder."""

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
# Repeated JSON keys shrink to a tenth or so; what expands more is no recording but a trap.
_MOST_EXPANSION: Final = 50
# A chunk's compression, as a prefixed string, and how far it is behind the chunk's first byte.
_CHUNK_MARK: Final = b"\x03\x00\x00\x00lz4"
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


class _File:
    """An unbuffered file: a write reaches the system or raises OSError, and is never repeated later."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        self._at = 0

    def write(self, data: bytes) -> int:
        """Write all of ``data``. Raises OSError."""
        rest = memoryview(data)
        while rest:
            written = os.write(self._fd, rest)
            self._at += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        """Bytes written so far."""
        return self._at

    def flush(self) -> None:
        """Nothing is held back."""

    def fileno(self) -> int:
        """For fsync."""
        return self._fd

    def close(self) -> None:
        """Close it; again does nothing."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


class Recorder:
    """Writer of one recording.

    Args:
        path: the file; overwritten.
        stream: where to write instead of opening ``path``; the recorder closes it.

    Raises:
        RecordingError: from any method, when the disk is full or gone. Nothing more is written after the first.
    """

    def __init__(self, path: Path, *, stream: IO[bytes] | None = None) -> None:
        self.path = path
        self._channels: dict[str, int] = {}
        self._failed = False
        try:
            self._stream: IO[bytes] = stream if stream is not None else cast(IO[bytes], _File(path))
        except OSError as error:
            raise self._failure(error) from None
        try:
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
            self._writer.start(profile="", library="touchcell")
        except OSError as error:
            self._stream.close()
            raise self._failure(error) from None

    @property
    def failed(self) -> bool:
        """True if a write has failed; nothing more is written then."""
        return self._failed

    def write(self, topic: str, t_ns: int, data: Mapping[str, Any]) -> None:
        """Append one message; numpy values become lists, and what is not finite becomes null."""
        self.write_encoded(topic, t_ns, encode(data))

    def write_encoded(self, topic: str, t_ns: int, data: bytes) -> None:
        """Append one message that ``encode`` has made."""
        if self._failed:
            raise RecordingError(self.path, "was closed by an earlier failure")
        try:
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._register(topic, data)
            # A chunk that is complete leaves the process at once.
            self._writer.add_message(channel, t_ns, data, t_ns)
        except OSError as error:
            raise self._failure(error) from None

    def sync(self) -> None:
        """Have the disk keep what has left the process: all but the open chunk, which a black box holds too."""
        if self._failed:
            return
        try:
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise self._failure(error) from None

    def close(self) -> None:
        """Finish the file with its index; after a failure, only close it."""
        try:
            if not self._failed:
                self._writer.finish()
                self._stream.flush()
        except OSError as error:
            raise self._failure(error) from None
        finally:
            self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, topic: str, first: bytes) -> int:
        schema = self._writer.register_schema(topic.strip("/").replace("/", "."), "jsonschema", _schema(first))
        self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        return self._channels[topic]

    def _failure(self, error: OSError) -> RecordingError:
        self._failed = True
        return RecordingError(
            self.path, f"cannot be written: {error.strerror}", hint="free some space; what was recorded is readable"
        )


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
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise RecordingError(path, "is not an MCAP file")
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


class _Damaged(Exception):
    """Bytes that are not what they should be."""


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
        self._topics: dict[int, str] = {}
        self._searched = False
        self._delivered = 0
        self._promised: int | None = None

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
            elif kind == Opcode.CHANNEL:
                self._register(content)
            elif kind == Opcode.MESSAGE:
                yield self._message(content, offset)
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
            if kind == Opcode.CHANNEL:
                self._register(record)
            elif kind == Opcode.MESSAGE:
                try:
                    message = self._message(record, offset)
                except _Damaged as error:
                    self._note(offset, str(error))
                else:
                    yield message
            at = end

    def _register(self, content: bytes) -> None:
        channel = Channel.read(ReadDataStream(BytesIO(content)))
        self._topics[channel.id] = channel.topic

    def _message(self, content: bytes, offset: int) -> Message:
        if len(content) < _MESSAGE_HEAD.size:
            raise _Damaged("a message is too short")
        channel, _, t_ns, _ = _MESSAGE_HEAD.unpack_from(content)
        topic = self._topics.get(channel)
        if topic is None and not self._searched:
            self._searched = True
            self._search_topics(offset)
            topic = self._topics.get(channel)
        if topic is None:
            raise _Damaged(f"a message is of channel {channel}, which nothing describes")
        try:
            data = json.loads(content[_MESSAGE_HEAD.size :])
        except (ValueError, RecursionError):
            raise _Damaged(f"a message of {topic} is no JSON") from None
        if not isinstance(data, dict):
            raise _Damaged(f"a message of {topic} is no JSON object")
        self._delivered += 1
        return Message(topic, t_ns, data)

    def _search_topics(self, offset: int) -> None:
        """Find channels whose first description was damaged: the summary at the end of a finished file repeats all."""
        while True:
            self._stream.seek(offset)
            head = self._stream.read(_RECORD_HEAD)
            length = int.from_bytes(head[1:], "little")
            if len(head) < _RECORD_HEAD or length > _LONGEST_RECORD or head[0] == Opcode.FOOTER:
                return
            if head[0] == Opcode.CHANNEL:
                try:
                    self._register(self._stream.read(length))
                except _UNREADABLE:
                    return
            offset += _RECORD_HEAD + length

    def _next_chunk(self, offset: int) -> int | None:
        """Where the next chunk behind ``offset`` begins, found by the name of its compression."""
        overlap = b""
        self._stream.seek(offset)
        at = offset
        while block := self._stream.read(_BLOCK_BYTES):
            held = overlap + block
            place = -1
            while (place := held.find(_CHUNK_MARK, place + 1)) >= 0:
                start = at - len(overlap) + place - _CHUNK_MARK_AT
                if start >= offset and self._is_kind(start, Opcode.CHUNK):
                    return start
            at += len(block)
            overlap = held[-len(_CHUNK_MARK) :]
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


def _unpacked(chunk: Chunk) -> bytes:
    """The records in a chunk, no longer than it says and no more often what is in the file than a recording can be."""
    size = chunk.uncompressed_size
    if size > _LONGEST_CHUNK or size > _MOST_EXPANSION * len(chunk.data) + CHUNK_BYTES:
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


def encode(data: Mapping[str, Any]) -> bytes:
    """A message as JSON; numpy values become lists, and what is not finite becomes null."""
    try:
        text = json.dumps(data, default=_plain, separators=(",", ":"), allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(data), default=_plain, separators=(",", ":"))
    return text.encode()


def _schema(message: bytes) -> bytes:
    """JSON schema of a topic with the fields of its first message, which viewers need to complete field names.

    Fields that are null in it are left out, since their type is unknown; later messages may have others.
    """
    try:
        described = _described(json.loads(message))
    except ValueError:
        described = None
    return json.dumps(described or {"type": "object"}, separators=(",", ":")).encode()


def _described(value: Any) -> dict[str, Any] | None:
    if isinstance(value, dict):
        fields = {key: described for key, item in value.items() if (described := _described(item)) is not None}
        return {"type": "object", "properties": fields}
    if isinstance(value, list):
        items = next((described for item in value if (described := _described(item)) is not None), None)
        return {"type": "array"} if items is None else {"type": "array", "items": items}
    if value is None:
        return None
    return {"type": "boolean" if isinstance(value, bool) else "string" if isinstance(value, str) else "number"}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be recorded")


def _finite(value: Any) -> Any:
    """Return the value with None in place of what JSON cannot represent."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
