"""MCAP recordings that survive a kill: small chunks, flushed as they close, and a reader for truncated files.

Messages are JSON with a JSON schema, so that Foxglove and the ``mcap`` command line read them without touchcell.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Chunk
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from touchcell.cell.errors import RecordingError

# A kill loses at most the open chunk: 16 KiB is a fraction of a second of a cell's usual 100 kB/s.
CHUNK_BYTES = 16 * 1024
RECORDING = "run.mcap"
"""Name of the recording in a run folder."""

_BLOCK_BYTES = 1 << 20
_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = 9


@dataclass(frozen=True, slots=True)
class Message:
    """One recorded message."""

    topic: str
    t_ns: int
    data: dict[str, Any]


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
            self._stream: IO[bytes] = stream if stream is not None else path.open("wb")
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
            self._writer.start(profile="", library="touchcell")
        except OSError as error:
            raise self._failure(error) from None

    @property
    def failed(self) -> bool:
        """True if a write has failed; nothing more is written then."""
        return self._failed

    def write(self, topic: str, t_ns: int, data: Mapping[str, Any]) -> None:
        """Append one message; numpy values become lists, and non-finite numbers become null."""
        if self._failed:
            raise RecordingError(self.path, "was closed by an earlier failure")
        try:
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._register(topic)
            self._writer.add_message(channel, t_ns, _encode(data), t_ns)
            # A complete chunk is flushed at once; between chunks this does nothing.
            self._stream.flush()
        except OSError as error:
            raise self._failure(error) from None

    def close(self) -> None:
        """Finish the file with its index."""
        if self._failed:
            return
        try:
            self._writer.finish()
            self._stream.close()
        except OSError as error:
            raise self._failure(error) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, topic: str) -> int:
        schema = self._writer.register_schema(topic.strip("/").replace("/", "."), "jsonschema", b'{"type":"object"}')
        self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        return self._channels[topic]

    def _failure(self, error: OSError) -> RecordingError:
        self._failed = True
        return RecordingError(
            self.path, f"cannot be written: {error.strerror}", hint="free some space; what was recorded is readable"
        )


def read(path: Path) -> Iterator[Message]:
    """Yield all complete messages of a recording in file order, also of one whose writer was killed.

    Raises:
        RecordingError: ``path`` is missing or not an MCAP file.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from None
    with stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise RecordingError(path, "is not an MCAP file")
        stream.seek(0)
        messages = NonSeekingReader(stream, validate_crcs=False).iter_messages(log_time_order=False)
        while True:
            try:
                _, channel, message = next(messages)
            except (StopIteration, McapError, EOFError, ValueError, RuntimeError, struct.error):
                # A truncated last chunk ends the file; everything before it has been delivered.
                return
            yield Message(channel.topic, message.log_time, json.loads(message.data))


def follow(path: Path, wait: Callable[[], bool]) -> Iterator[Message]:
    """Yield all messages of a recording that may still be written, and those added to it, until it is finished.

    Args:
        path: the recording.
        wait: called when there is nothing new; returns False to stop waiting.

    Raises:
        RecordingError: ``path`` is missing or not an MCAP file.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from None
    topics: dict[int, str] = {}
    with stream:
        held = b""
        while len(held) < len(_MAGIC):
            held += stream.read(len(_MAGIC) - len(held))
            if len(held) < len(_MAGIC) and not wait():
                return
        if held != _MAGIC:
            raise RecordingError(path, "is not an MCAP file")
        held = b""
        while True:
            held += stream.read(_BLOCK_BYTES)
            length = int.from_bytes(held[1:9], "little") if len(held) >= _RECORD_HEAD else 0
            if len(held) < _RECORD_HEAD + length or len(held) < _RECORD_HEAD:
                if stream.tell() == path.stat().st_size and not wait():
                    return
                continue
            kind, content = held[0], held[_RECORD_HEAD : _RECORD_HEAD + length]
            held = held[_RECORD_HEAD + length :]
            if kind == Opcode.FOOTER:
                return
            if kind != Opcode.CHUNK:
                continue
            for record in breakup_chunk(Chunk.read(ReadDataStream(BytesIO(content)))):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, McapMessage):
                    yield Message(topics[record.channel_id], record.log_time, json.loads(record.data))


def _encode(data: Mapping[str, Any]) -> bytes:
    try:
        text = json.dumps(data, default=_plain, separators=(",", ":"), allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(data), default=_plain, separators=(",", ":"))
    return text.encode()


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
