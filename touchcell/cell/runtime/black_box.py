"""The black box: the last ten seconds of a run in memory, written beside the recording when something went wrong.

It holds what the recording holds, and is there also when nothing is recorded or the disk filled up on the way.
"""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Recorder
from touchcell.cell.runtime.run_result import RunResult
from touchcell.cell.runtime.stopping import StopReport
from touchcell.control.interlocks.violation import Violation

SECONDS: Final = 10.0
MESSAGES: Final = "blackbox.mcap"
ABOUT: Final = "blackbox.json"


class BlackBox:
    """A ring of messages.

    Args:
        seconds: how far back it reaches.
    """

    def __init__(self, seconds: float = SECONDS) -> None:
        self._span_ns = round(1e9 * seconds)
        self._messages: deque[tuple[str, int, Mapping[str, Any]]] = deque()

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, topic: str, t_ns: int, data: Mapping[str, Any]) -> None:
        """Keep one message, and let go of those that have become too old."""
        messages = self._messages
        messages.append((topic, t_ns, data))
        while messages[0][1] < t_ns - self._span_ns:
            messages.popleft()

    def dump(self, folder: Path, result: RunResult, about: Mapping[str, Any]) -> None:
        """Write the messages and what they are about into ``folder``.

        Args:
            folder: the run folder.
            result: how the run ended.
            about: what else belongs to it: the cell and the hash of its file.

        Raises:
            RecordingError: the disk is full or gone.
        """
        with Recorder(folder / MESSAGES) as recorder:
            for topic, t_ns, data in self._messages:
                recorder.write(topic, t_ns, data)
        record = {
            **about,
            "outcome": result.outcome.value,
            "reason": result.reason,
            "state": result.state,
            "causes": [cause_record(cause) for cause in result.causes],
            "stops": {role: stop_record(report) for role, report in result.stops.items()},
        }
        try:
            (folder / ABOUT).write_text(json.dumps(record, indent=1) + "\n")
        except OSError as error:
            raise RecordingError(folder / ABOUT, f"cannot be written: {error.strerror}") from None


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
