"""Where a person asks a run that has tripped to reset and to go on, by a key or from another shell, and is answered.

From another shell a request is a file in the run folder and the answer another; each is replaced as a whole. Requests
are taken only while the run waits: what was asked before counts for nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections import deque
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final

_WAITING: Final = "waiting"
_REQUEST: Final = "request.json"
_ANSWER: Final = "answer.json"
_WAIT_S: Final = 10.0
_POLL_S: Final = 0.02


class OperatorRequest(Enum):
    """What may be asked of a run that waits."""

    RESET = "reset"
    RESUME = "resume"


@dataclass(frozen=True, slots=True)
class Request:
    """One request.

    Attributes:
        ask: for what.
        operator: who asks.
        number: by which another shell knows its answer; None for a key.
    """

    ask: OperatorRequest
    operator: str
    number: int | None = None


class OperatorChannel:
    """Takes requests while it is open.

    Args:
        folder: the run folder, for requests from other shells; None takes only those of ``ask``.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._asked: deque[Request] = deque()
        self._open = False
        self.last_reply = ""

    def open(self) -> None:
        """The run waits from now on. Whatever was asked before is forgotten."""
        self._asked.clear()
        self.last_reply = ""
        self._open = True
        if self._folder is not None:
            (self._folder / _REQUEST).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                (self._folder / _WAITING).touch()

    def close(self) -> None:
        """The run waits no longer."""
        self._open = False
        if self._folder is not None:
            for name in (_WAITING, _REQUEST):
                (self._folder / name).unlink(missing_ok=True)

    def ask(self, ask: OperatorRequest, operator: str) -> None:
        """Ask from within this process."""
        if self._open:
            self._asked.append(Request(ask, operator))

    def take(self) -> Request | None:
        """The next request, or None."""
        if self._open and self._folder is not None and (data := _read(self._folder / _REQUEST)) is not None:
            (self._folder / _REQUEST).unlink(missing_ok=True)
            with contextlib.suppress(KeyError, ValueError, TypeError):
                self._asked.append(Request(OperatorRequest(data["ask"]), str(data["operator"]), int(data["number"])))
        return self._asked.popleft() if self._asked else None

    def answer(self, request: Request, done: bool, words: str) -> None:
        """Tell whoever asked what became of it."""
        self.last_reply = words
        if request.number is not None and self._folder is not None:
            with contextlib.suppress(OSError):
                _write(self._folder / _ANSWER, {"number": request.number, "done": done, "words": words})


def is_waiting(folder: Path) -> bool:
    """Whether the run in ``folder`` has tripped and waits for a person."""
    return (folder / _WAITING).exists()


def ask_run(folder: Path, ask: OperatorRequest, operator: str, wait_s: float = _WAIT_S) -> tuple[bool, str]:
    """Ask the waiting run in ``folder``; returns whether it was done, and in words what became of it."""
    number = time.monotonic_ns()
    _write(folder / _REQUEST, {"ask": ask.value, "operator": operator, "number": number})
    deadline_s = time.monotonic() + wait_s
    while time.monotonic() < deadline_s:
        answer = _read(folder / _ANSWER)
        if answer is not None and answer.get("number") == number:
            return bool(answer["done"]), str(answer["words"])
        time.sleep(_POLL_S)
    (folder / _REQUEST).unlink(missing_ok=True)
    return False, "no answer: does the run still go on?"


def _read(file: Path) -> dict[str, Any] | None:
    try:
        data = json.loads(file.read_text())
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None


def _write(file: Path, data: dict[str, Any]) -> None:
    whole = file.with_name(f"{file.name}.{os.getpid()}")
    whole.write_text(json.dumps(data))
    whole.replace(file)
