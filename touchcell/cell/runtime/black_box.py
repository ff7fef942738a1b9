"""The black box: the last ten seconds of a run, in a file that outlives the run's process.

It holds what the recording holds but images, and survives whatever ends the run: a trip, a failure, `kill -9`, a crash,
a lack of memory, a full disk. A run that ends by itself writes it as ``blackbox.mcap`` and ``blackbox.json`` for people
and other programs, and removes the ring; a ring that is left belongs to a run that could not.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Message
from touchcell.cell.recording.message_types import Encoded, Encoder
from touchcell.cell.recording.messages import declared_type
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.recording.ring import RingWriter, read_ring
from touchcell.cell.runtime.run_result import RunResult
from touchcell.cell.runtime.stopping import StopReport
from touchcell.control.interlocks.violation import Violation

SECONDS: Final = 10.0
RING: Final = "blackbox.ring"
MESSAGES: Final = "blackbox.mcap"
ABOUT: Final = "blackbox.json"
CRASH: Final = "crash.txt"
"""Where the interpreter writes its stack when it is ended by a signal such as SIGSEGV."""
_END_TOPIC: Final = "/blackbox"
# Ten seconds of a cell with two arms and two sensors at 100 Hz are about 10 MB.
_RING_BYTES: Final = 16 << 20


class BlackBox:
    """A ring of messages; as a context manager it is closed at the end, and its file stays until ``discard``.

    Args:
        folder: the run folder; None keeps the ring in this process's memory only.
        about: what belongs to it: the cell, the hash of its file, the time of the start.

    Raises:
        RecordingError: the disk has no room for it.
    """

    def __init__(self, folder: Path | None = None, about: Mapping[str, Any] | None = None) -> None:
        self._about = dict(about or {})
        self._ring = RingWriter(None if folder is None else folder / RING, _RING_BYTES, self._about)

    def add(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        """Keep topics, stamps and messages that are encoded as for the recording; never fails."""
        self._ring.add(messages)

    def messages(self) -> list[Message]:
        """Those of the last ten seconds, oldest first."""
        return _latest([message for message in self._ring.messages() if message.topic != _END_TOPIC])

    def dump(self, folder: Path, result: RunResult, start_ns: int | None = None) -> None:
        """Write the messages, and how the run ended, into ``folder``.

        Args:
            folder: the run folder.
            result: how the run ended.
            start_ns: when the devices were active, where that is not when the box was made.

        Raises:
            RecordingError: the disk is full or gone; all of it is in the ring then.
        """
        if start_ns is not None:
            self._about["start_ns"] = start_ns
        record = {
            **self._about,
            "outcome": result.outcome.value,
            "reason": result.reason,
            "state": result.state,
            "causes": [cause_record(cause) for cause in result.causes],
            "stops": {role: stop_record(report) for role, report in result.stops.items()},
        }
        messages = self.messages()
        end = Encoder(declared_type).encode(_END_TOPIC, {"json": json.dumps(record)})
        self._ring.add([(_END_TOPIC, messages[-1].t_ns if messages else 0, end)])
        self._ring.sync()
        try:
            self._write(folder, messages, record)
        except RecordingError:
            # Half a black box would be read in place of the ring.
            for name in (MESSAGES, ABOUT):
                with contextlib.suppress(OSError):
                    (folder / name).unlink()
            raise

    def _write(self, folder: Path, messages: list[Message], record: Mapping[str, Any]) -> None:
        with Recorder(folder / MESSAGES) as recorder:
            for message in messages:
                recorder.write(message.topic, message.t_ns, message.data)
        try:
            with (folder / ABOUT).open("w") as file:
                file.write(json.dumps(record, indent=1) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise RecordingError(folder / ABOUT, f"cannot be written: {error.strerror}") from None

    def discard(self) -> None:
        """Remove the ring: all that it holds is elsewhere, or not worth keeping."""
        self.close()
        if self._ring.path is not None:
            with contextlib.suppress(OSError):
                self._ring.path.unlink()

    def close(self) -> None:
        """Let go of the ring, whose file stays."""
        self._ring.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_left_ring(folder: Path) -> tuple[dict[str, Any], list[Message]]:
    """What a run has left in its ring: its record, with ``outcome`` if it came to an end, and its latest messages.

    Raises:
        RecordingError: there is no ring, or it is damaged.
    """
    about, messages = read_ring(folder / RING)
    for message in messages:
        if message.topic == _END_TOPIC:
            about = json.loads(message.data["json"])
    return about, _latest([message for message in messages if message.topic != _END_TOPIC])


def _latest(messages: list[Message]) -> list[Message]:
    newest_ns = max((message.t_ns for message in messages), default=0)
    return [message for message in messages if message.t_ns >= newest_ns - round(1e9 * SECONDS)]


@contextlib.contextmanager
def note_crashes(folder: Path) -> Iterator[None]:
    """While inside, SIGSEGV and its like leave the interpreter's stack in ``crash.txt``."""
    import faulthandler

    if faulthandler.is_enabled():
        # Somebody has chosen another place for it.
        yield
        return
    path = folder / CRASH
    with path.open("w") as file:
        faulthandler.enable(file)
        try:
            yield
        finally:
            faulthandler.disable()
    with contextlib.suppress(OSError):
        if path.stat().st_size == 0:
            path.unlink()


def keep_earlier(folder: Path) -> None:
    """Put the black box of an earlier trip of the same run aside, as ``blackbox-1`` and so on."""
    if (folder / ABOUT).exists():
        number = 1 + len(list(folder.glob("blackbox-*.json")))
        for name in (MESSAGES, ABOUT):
            file = folder / name
            with contextlib.suppress(OSError):
                file.rename(file.with_stem(f"{file.stem}-{number}"))


def cause_record(cause: Violation) -> dict[str, Any]:
    """A violation as plain data."""
    return {**asdict(cause), "severity": cause.severity.name.lower()}


def stop_record(report: StopReport) -> dict[str, Any]:
    """A stop as plain data."""
    return {**asdict(report), "category": int(report.category), "kept": report.kept}
