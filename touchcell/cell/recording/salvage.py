"""Recordings that were cut off, written anew for programs that read only whole ones."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

_UNREADABLE: Final = (
    McapError,
    ZstdError,
    ValueError,
    RuntimeError,
    OSError,
    EOFError,
    MemoryError,
    OverflowError,
    struct.error,
)
"""What the parsers of records and chunks raise for bytes that are none."""


@contextmanager
def whole(recording: Path) -> Iterator[Path]:
    """Yield a file with all of a recording, up to where it is cut off: itself where it is not.

    Args:
        recording: an MCAP file.
    """
    if _is_finished(recording):
        yield recording
        return
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / recording.name
        _copy(recording, target)
        yield target


def _is_finished(recording: Path) -> bool:
    with recording.open("rb") as stream:
        try:
            return any(isinstance(record, Footer) for record in StreamReader(stream, emit_chunks=True).records)
        except _UNREADABLE:
            return False


def _copy(recording: Path, target: Path) -> None:
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    with recording.open("rb") as stream, target.open("wb") as copy:
        writer = Writer(copy, compression=CompressionType.LZ4)
        writer.start()
        with suppress(*_UNREADABLE):
            for record in StreamReader(stream).records:
                if isinstance(record, Schema):
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                elif isinstance(record, Channel):
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schemas.get(record.schema_id, 0), dict(record.metadata)
                    )
                elif isinstance(record, Message):
                    writer.add_message(
                        channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
                    )
                elif isinstance(record, Attachment):
                    writer.add_attachment(
                        record.create_time, record.log_time, record.name, record.media_type, record.data
                    )
                elif isinstance(record, Metadata):
                    writer.add_metadata(record.name, dict(record.metadata))
        writer.finish()
