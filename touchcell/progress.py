"""Progress of long work: bars on a terminal, elsewhere a line now and then beside the output."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Final, Protocol

LINE_PERIOD_S: Final = 30.0
"""Shortest time between two lines where there is no terminal."""


class Show(Protocol):
    """Shows how far something is."""

    def __call__(self, what: str, done: int, total: int, detail: str = "") -> None:
        """Show that ``done`` of ``total`` steps of ``what`` are done.

        Args:
            what: names the work; each has a bar of its own.
            done, total: steps.
            detail: what was done last.
        """
        ...


@contextmanager
def shown_progress(*, live: bool = True) -> Iterator[Show]:
    """Yield a function that shows progress: on standard output if that is a terminal, else on standard error.

    Args:
        live: False shows nothing, for callers that are no command line.
    """
    if not live:
        yield _nothing
    elif sys.stdout.isatty():
        with _bars(sys.stdout) as show:
            yield show
    else:
        yield ProgressLines()


class ProgressLines:
    """Writes a line at most every ``LINE_PERIOD_S``, so that a log shows progress.

    Args:
        stream: where; None for standard error.
        clock: seconds.
    """

    def __init__(self, stream: IO[str] | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        self._due_s = clock() + LINE_PERIOD_S

    def __call__(self, what: str, done: int, total: int, detail: str = "") -> None:
        if self._clock() < self._due_s:
            return
        self._due_s = self._clock() + LINE_PERIOD_S
        print(
            f"{what}: {done} of {total}" + (f", {detail}" if detail else ""),
            file=self._stream or sys.stderr,
            flush=True,
        )


@contextmanager
def _bars(stream: IO[str]) -> Iterator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, transient=True, console=Console(file=stream)) as bars:

        def show(what: str, done: int, total: int, detail: str = "") -> None:
            if what not in tasks:
                # What was done before took no time now, and must not shorten the estimate.
                tasks[what] = bars.add_task(what, total=total, completed=max(done - 1, 0))
            bars.update(tasks[what], completed=done, total=total, description=f"{what}: {detail}" if detail else what)

        yield show


def _nothing(what: str, done: int, total: int, detail: str = "") -> None:
    """Show nothing."""
