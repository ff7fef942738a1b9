"""How a person stops a running cell, and resumes one that has tripped: keys, signals, a lost terminal, other shells.

All of them only ask; the loop looks once a cycle. This is no emergency stop: that one is wired.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Final

from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest, operator_name
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.errors import TouchcellError

PID_FILE: Final = "pid"
AT_ONCE_KEYS: Final = b" \x1b"
"""Space and Esc; so does every arrow or function key, which begins with Esc."""
ORDERLY_KEYS: Final = b"sSqQ"
ASK_KEYS: Final = {ord("r"): OperatorRequest.RESET, ord("g"): OperatorRequest.RESUME}
_WAIT_S = 20.0
_POLL_S = 0.05


class NoSuchRun(TouchcellError):
    """There is no run to ask.

    Attributes:
        folder: where it was looked for.
    """

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(f"{folder}: {reason}", hint="name the folder of a run that goes on")
        self.folder = folder


class FolderInUse(TouchcellError):
    """Another run is in progress in the run folder.

    Attributes:
        folder: the run folder.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder}: another run goes on here", hint="choose another folder with --out")
        self.folder = folder


@contextlib.contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """The first Ctrl-C, SIGTERM or lost terminal ends the task in an orderly way, the second stops at once."""
    if threading.current_thread() is not threading.main_thread():
        # Python delivers signals to the main thread, and lets no other set a handler.
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.ask()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def stop_on_keys(
    stop: StopRequest, stream: IO[str] | None = None, channel: OperatorChannel | None = None
) -> Iterator[Callable[[], None]]:
    """Yield what the loop calls once a cycle to read the operator's keys.

    Space or Esc stop at once, s or q end in an orderly way; r asks ``channel`` for a reset, g to resume. A terminal
    that is gone stops at once too. Where ``stream`` (standard input) is no terminal, or belongs to another job of the
    shell, no key is read. The terminal is left as it was found.
    """
    with terminal_keys(sys.stdin if stream is None else stream) as read:
        yield (lambda: None) if read is None else (lambda: _look(read, stop, channel))


@contextlib.contextmanager
def terminal_keys(stream: IO[str]) -> Iterator[Callable[[], bytes | None] | None]:
    """Yield what reads the keys that have been pressed in a terminal: none yet as b"", a terminal that is gone as None.

    Yields None itself where ``stream`` is no terminal, or belongs to another job of the shell. The terminal is left as
    it was found.
    """
    fd = _terminal(stream)
    if fd is None:
        yield None
        return
    import termios
    import tty

    try:
        before = termios.tcgetattr(fd)
        tty.setcbreak(fd)
    except (termios.error, OSError):
        # It has gone in the meantime, which its hang-up signal reports.
        yield None
        return
    try:
        yield lambda: _pressed(fd)
    finally:
        # A terminal that is gone needs no repair.
        with contextlib.suppress(termios.error):
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def _terminal(stream: IO[str]) -> int | None:
    try:
        fd = stream.fileno()
        return fd if os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp() else None
    except (OSError, ValueError):
        return None


def _pressed(fd: int) -> bytes | None:
    try:
        if not select.select([fd], [], [], 0.0)[0]:
            return b""
        return os.read(fd, 256) or None
    except (OSError, ValueError):
        return None


def _look(read: Callable[[], bytes | None], stop: StopRequest, channel: OperatorChannel | None) -> None:
    keys = read()
    if keys == b"":
        return
    if keys is None or any(key in AT_ONCE_KEYS for key in keys):
        stop.ask_at_once()
    elif any(key in ORDERLY_KEYS for key in keys):
        stop.ask()
    elif channel is not None:
        for key in dict.fromkeys(keys.lower()):
            if key in ASK_KEYS:
                channel.ask(ASK_KEYS[key], operator_name())


@contextlib.contextmanager
def reachable(folder: Path) -> Iterator[None]:
    """While inside, ``touchcell stop FOLDER`` finds this process: by a file with its number, locked while it lives.

    Raises:
        FolderInUse: another run is in progress there.
    """
    with (folder / PID_FILE).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderInUse(folder) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        try:
            yield
        finally:
            # A folder that has vanished needs no tidying.
            with contextlib.suppress(OSError):
                (folder / PID_FILE).unlink()


def running(runs: Path) -> list[Path]:
    """Folders below ``runs`` whose run is in progress."""
    return sorted(file.parent for file in runs.glob(f"*/{PID_FILE}") if _owner(file) is not None)


def is_running(folder: Path) -> bool:
    """Whether the run in ``folder`` is in progress."""
    return _owner(folder / PID_FILE) is not None


def ask_to_stop(folder: Path, *, at_once: bool) -> None:
    """Ask the run in ``folder`` to stop.

    Raises:
        NoSuchRun: nothing runs there.
    """
    pid = _owner(folder / PID_FILE)
    if pid is None:
        raise NoSuchRun(folder, "no run goes on here")
    # Two different signals: two of the same kind may arrive as one. A run that ends meanwhile has stopped.
    with contextlib.suppress(ProcessLookupError):
        for number in (signal.SIGTERM, signal.SIGINT) if at_once else (signal.SIGTERM,):
            os.kill(pid, number)


def await_end(folder: Path, wait_s: float = _WAIT_S) -> bool:
    """Whether the run in ``folder`` has ended, ``wait_s`` from now at the latest."""
    deadline_s = time.monotonic() + wait_s
    while _owner(folder / PID_FILE) is not None:
        if time.monotonic() > deadline_s:
            return False
        time.sleep(_POLL_S)
    return True


def _owner(file: Path) -> int | None:
    """Process that holds the file; None where no process does, so that a number left by a crash reaches no stranger."""
    try:
        with file.open() as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                text = stream.read()
                return int(text) if text.isdigit() else None
    except OSError:
        pass
    return None
