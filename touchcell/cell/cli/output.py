"""Output that nothing depends on: a reader who has gone, or a full disk behind it, changes no exit code."""

from __future__ import annotations

import logging
import os
import sys
from typing import TextIO

logger = logging.getLogger(__name__)


def say(text: str, stream: TextIO | None = None) -> None:
    """Print ``text`` to ``stream`` (standard output); where that fails, nothing more goes there."""
    stream = sys.stdout if stream is None else stream
    try:
        print(text, file=stream, flush=True)
    except (OSError, ValueError) as error:
        _silence(stream, error)


def warn(text: str) -> None:
    """Print ``text`` to standard error as touchcell's."""
    say(f"touchcell: {text}", sys.stderr)


def flush_output() -> None:
    """Write what is still held back, so that Python has nothing to complain about when it exits."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError) as error:
            _silence(stream, error)


def _silence(stream: TextIO, error: Exception) -> None:
    """Let ``stream`` lead nowhere: what it still holds would otherwise fail again when Python exits."""
    logger.info("output ends: %s", error)
    if stream is not sys.stderr and not isinstance(error, BrokenPipeError):
        warn(f"no more output: {error}")
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
    except (OSError, ValueError):
        # A stream without a file, or one that is closed, has nothing to fail with.
        pass
