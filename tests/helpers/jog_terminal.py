"""``touchcell jog`` in a process and a terminal of its own, whose keys the test holds."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable

_LAUNCH = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.argv[0] = "touchcell"
from touchcell.cell.cli.main import main
sys.exit(main())
"""
_REPEAT_S = 0.03


class JogTerminal:
    """A context manager; the process leads a session with the terminal, as a shell would start it.

    Args:
        arguments: of ``touchcell``.

    Attributes:
        text: what the terminal has shown, without its control sequences.
    """

    def __init__(self, *arguments: str) -> None:
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-c", _LAUNCH, *arguments],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env=os.environ | {"TERM": "xterm", "COLUMNS": "200", "OMP_NUM_THREADS": "1"},
        )
        os.close(slave)
        self.text = ""

    def hold(self, keys: bytes, until: Callable[[], bool], limit_s: float = 30.0) -> None:
        """Repeat ``keys`` as a terminal does, until a condition holds."""
        end_s = time.monotonic() + limit_s
        while not until():
            assert time.monotonic() < end_s, self.text[-2000:]
            assert self.process.poll() is None, self.text[-2000:]
            if keys:
                os.write(self._master, keys)
            self.look(_REPEAT_S)

    def shows(self, text: str) -> Callable[[], bool]:
        """A condition: the text has been shown from now on."""
        start = len(self.text)
        return lambda: text in self.text[start:]

    def press(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def look(self, wait_s: float) -> None:
        """Read what is shown within a time."""
        end_s = time.monotonic() + wait_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            if select.select([self._master], [], [], left_s)[0]:
                try:
                    shown = os.read(self._master, 65536)
                except OSError:
                    return
                self.text += re.sub(rb"\x1b\[[0-9;?]*[A-Za-z]", b"", shown).decode(errors="replace")

    def close_terminal(self) -> None:
        os.close(self._master)
        self._master = -1

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def __enter__(self) -> JogTerminal:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.kill()
        if self._master >= 0:
            with contextlib.suppress(OSError):
                os.close(self._master)
