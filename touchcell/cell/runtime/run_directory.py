"""The folder of a run: made for it alone, locked before anything is written into it, never one with other evidence."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from touchcell.cell.runtime.operator_input import PID_FILE, reachable
from touchcell.errors import TouchcellError

RUNS: Final = Path("runs")
"""Where run folders are made unless the operator names one."""


class RunFolderError(TouchcellError):
    """A run folder cannot be made or used.

    Attributes:
        folder: the folder.
    """

    def __init__(self, folder: Path, reason: str, *, hint: str = "name another folder with --out") -> None:
        super().__init__(f"{folder}: {reason}", hint=hint)
        self.folder = folder


@contextlib.contextmanager
def run_directory(name: str, out: Path | None = None, runs: Path = RUNS) -> Iterator[Path]:
    """Make the folder of a run and keep it locked while inside, so that ``touchcell stop`` finds the run.

    Args:
        name: of the cell; the folder is ``runs/NAME-TIME``.
        out: a folder to make or to use if it is empty, in place of that.
        runs: where folders are made without ``out``.

    Raises:
        RunFolderError: it cannot be made, or holds anything.
        FolderInUse: another run is in it.
    """
    folder = _made(runs, f"{name}-{time.strftime('%Y%m%d-%H%M%S')}") if out is None else out
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            _require_empty(out)
        with contextlib.ExitStack() as stack:
            stack.enter_context(reachable(folder))
            # Another run may have come and gone since.
            _require_empty(folder)
            locked = stack.pop_all()
    except OSError as error:
        raise RunFolderError(folder, f"cannot be a run folder: {error.strerror}") from None
    with locked:
        yield folder


def _made(runs: Path, name: str) -> Path:
    """A new folder below ``runs``: ``name``, or with a number where another run began in the same second."""
    for number in itertools.count(1):
        folder = runs / (name if number == 1 else f"{name}-{number}")
        if folder.parent != runs:
            raise RunFolderError(folder, f"is not in {runs}", hint="change the cell's `name:`")
        try:
            runs.mkdir(parents=True, exist_ok=True)
            folder.mkdir()
        except FileExistsError:
            if not runs.is_dir():
                raise RunFolderError(runs, "is no folder") from None
            continue
        except OSError as error:
            raise RunFolderError(folder, f"cannot be made: {error.strerror}") from None
        return folder
    raise AssertionError


def _require_empty(folder: Path) -> None:
    if any(entry.name != PID_FILE for entry in folder.iterdir()):
        raise RunFolderError(
            folder, "holds something already", hint="name a new folder with --out; no run is overwritten"
        )
