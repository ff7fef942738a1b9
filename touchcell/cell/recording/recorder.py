"""Writer of MCAP recordings that survive a kill: small chunks, each handed to the system in one call as it closes.

Messages are protobuf, with their schemas in the file, so that Foxglove, Rerun and the ``mcap`` tools read them without
touchcell.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Final, Protocol, Self

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import CELL_CLOCK
from touchcell.cell.recording.message_types import Encoded, Encoder
from touchcell.cell.recording.messages import declared_type
from touchcell.errors import ConfigError

if TYPE_CHECKING:
    from foxglove import Context
    from foxglove._foxglove_py import BaseChannel

CHUNK_BYTES: Final = 24 * 1024
MOST_OPEN: Final = 150
"""Messages in the open chunk, which a kill loses, beyond which it is closed at the end of the cycle."""
_LONGEST_OPEN_NS: Final = 250_000_000
"""Time after which it is closed too, for pages that follow the file."""

LOOPBACK: Final = "127.0.0.1"
_BACKLOG: Final = 1024


class RecordedType(Protocol):
    """Protobuf type of a message."""

    @property
    def full_name(self) -> str:
        """Name with the package."""
        ...

    @property
    def schema(self) -> bytes:
        """Serialized FileDescriptorSet."""
        ...


class Recorder:
    """Writer of one recording.

    Args:
        path: the file; overwritten.
        stream: where to write instead of opening ``path``; the recorder closes it.
        wall_offset_ns: wall clock minus the cell's clock. Stamps in the file are of the wall clock, which viewers show;
            readers subtract it again.

    Attributes:
        encoder: encodes messages for it.
        context: of the channels.
        live: whether viewers may join at any time, to whom what stands still has to be sent again.

    Raises:
        RecordingError: from any method, when the disk is full or gone. Nothing more is written after the first.
    """

    def __init__(self, path: Path, *, stream: IO[bytes] | None = None, wall_offset_ns: int = 0) -> None:
        import foxglove
        from foxglove.mcap import MCAPCompression, MCAPWriteOptions

        self.path = path
        self.wall_offset_ns = wall_offset_ns
        self.encoder = Encoder(declared_type)
        self.context: Context = foxglove.Context()
        self._channels: dict[str, tuple[RecordedType, BaseChannel]] = {}
        self._failed = False
        self._open_messages = 0
        self._opened_ns = 0
        self.live = False
        try:
            self._stream = _Stream(_File(path) if stream is None else stream)
        except OSError as error:
            raise self._failure(error) from None
        self._writer = foxglove.open_mcap(
            self._stream,  # type: ignore[arg-type]
            context=self.context,
            writer_options=MCAPWriteOptions(
                compression=MCAPCompression.Zstd,
                compression_level=3,
                # In this thread, instead of in many of its own.
                compression_threads=0,
                chunk_size=CHUNK_BYTES,
                # A chunk is then written once, in whole, and never patched.
                disable_seeking=True,
            ),
        )
        try:
            self._stream.write_out()
        except OSError as error:
            self._stream.close()
            raise self._failure(error) from None

    @property
    def failed(self) -> bool:
        """True if a write has failed; nothing more is written then."""
        return self._failed

    def write(self, topic: str, t_ns: int, data: Mapping[str, Any]) -> None:
        """Append one message; numpy values become lists. Raises TypeError for what cannot be recorded."""
        self.write_encoded([(topic, t_ns, self.encoder.encode(topic, data))])

    def write_encoded(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        """Append topics, stamps and messages that ``encoder`` has made."""
        self._require_working()
        for topic, t_ns, message in messages:
            present = self._channels.get(topic)
            type_ = message.type
            channel = present[1] if present is not None and present[0] is type_ else self._open(topic, type_)
            channel.log(message.data, t_ns + self.wall_offset_ns)
        if messages:
            self._settle(len(messages), messages[-1][1])

    def write_bytes(self, topic: str, t_ns: int, type_: RecordedType, data: bytes) -> None:
        """Append one message of any type."""
        self._require_working()
        present = self._channels.get(topic)
        channel = present[1] if present is not None and present[0] is type_ else self._open(topic, type_)
        channel.log(data, t_ns + self.wall_offset_ns)
        self._settle(1, t_ns)

    def attach(self, name: str, media_type: str, data: bytes, t_ns: int) -> None:
        """Append a file, as the cell's own."""
        self._require_working()
        t_wall_ns = t_ns + self.wall_offset_ns
        self._writer.attach(log_time=t_wall_ns, create_time=t_wall_ns, name=name, media_type=media_type, data=data)
        self._write_out()

    def describe(self, name: str, metadata: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._require_working()
        self._writer.write_metadata(name, dict(metadata))
        self._write_out()

    @contextmanager
    def serve(self, name: str, port: int) -> Iterator[str]:
        """Send every message to viewers on this machine too, by the Foxglove WebSocket; yields the address.

        A viewer that does not keep up loses the oldest of its messages, and holds nothing up.

        Args:
            name: shown by viewers.
            port: TCP port on the loopback interface; 0 for any that is free.

        Raises:
            ConfigError: the port is taken.
        """
        import foxglove

        try:
            server = foxglove.start_server(
                name=name, host=LOOPBACK, port=port, context=self.context, message_backlog_size=_BACKLOG
            )
        except Exception as error:
            raise ConfigError(
                f"cannot be served at: {error}", key="--live-port", value=port, hint="--live-port 0 takes a free one"
            ) from None
        self.live = True
        try:
            yield f"ws://{LOOPBACK}:{server.port}"
        finally:
            self.live = False
            server.stop()

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
            self._writer.close()
            if not self._failed:
                self._write_out()
        finally:
            self._stream.close()
            for _, channel in self._channels.values():
                channel.close()
            self._channels.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, topic: str, type_: RecordedType) -> BaseChannel:
        from foxglove import Schema

        if topic in self._channels:
            # Its type has grown: the same topic goes on in another channel.
            self._channels[topic][1].close()
        # Not by ``foxglove.Channel``, which keeps every channel for the life of the process.
        channel = self.context._create_channel(
            topic,
            message_encoding="protobuf",
            schema=Schema(name=type_.full_name, encoding="protobuf", data=type_.schema),
            metadata={CELL_CLOCK: str(self.wall_offset_ns)},
        )
        self._channels[topic] = type_, channel
        return channel

    def _settle(self, count: int, t_ns: int) -> None:
        """Hand a chunk that is complete to the system; complete one that has waited long enough."""
        if self._stream.holds:
            self._write_out()
            self._open_messages, self._opened_ns = 0, t_ns
        self._open_messages += count
        if self._open_messages >= MOST_OPEN or t_ns - self._opened_ns >= _LONGEST_OPEN_NS:
            self._writer.flush()
            self._write_out()
            self._open_messages, self._opened_ns = 0, t_ns

    def _write_out(self) -> None:
        try:
            self._stream.write_out()
        except OSError as error:
            raise self._failure(error) from None

    def _require_working(self) -> None:
        if self._failed:
            raise RecordingError(self.path, "was closed by an earlier failure")

    def _failure(self, error: OSError) -> RecordingError:
        self._failed = True
        return RecordingError(
            self.path, f"cannot be written: {error.strerror}", hint="free some space; what was recorded is readable"
        )


class _File:
    """An unbuffered file: a write reaches the system or raises OSError, and is never repeated later."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)

    def write(self, data: bytes) -> int:
        """Write all of ``data``. Raises OSError."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._fd, rest) :]
        return len(data)

    def fileno(self) -> int:
        """Descriptor, for fsync."""
        return self._fd

    def close(self) -> None:
        """Close it; again does nothing."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


class _Stream:
    """What the MCAP writer writes to: holds it until ``write_out``, since the writer would report no error."""

    def __init__(self, file: IO[bytes] | _File) -> None:
        self._file = file
        self._at = 0
        self._held: list[bytes] = []

    @property
    def holds(self) -> bool:
        """Whether anything waits."""
        return bool(self._held)

    def write(self, data: bytes) -> int:
        self._held.append(bytes(data))
        self._at += len(data)
        return len(data)

    def write_out(self) -> None:
        """Write what waits to the file, in one call. Raises OSError."""
        if self._held:
            data = b"".join(self._held)
            self._held.clear()
            self._file.write(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Return the position, which the writer only asks for."""
        return self._at

    def flush(self) -> None:
        """Nothing: ``write_out`` does it."""

    def fileno(self) -> int:
        return self._file.fileno()

    def close(self) -> None:
        self._file.close()
