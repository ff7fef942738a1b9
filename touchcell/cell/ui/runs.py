"""The runs and cells that the operator's page lists, and what it may ask of them."""

from __future__ import annotations

import subprocess
import sys
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.runtime.operator_channel import OperatorRequest, ask_run, operator_name
from touchcell.cell.runtime.operator_input import NoSuchRun, ask_to_stop, is_running
from touchcell.cell.runtime.result_record import RESULT, read_record
from touchcell.cell.ui.run_view import RunView, sources
from touchcell.paths import CONFIGS

_MOST_VIEWS: Final = 6
_MOST_LISTED: Final = 200
_MOST_STARTED: Final = 2


@dataclass(frozen=True, slots=True)
class ListedRun:
    """A run folder: its name, how the run ended, and whether it is in progress."""

    name: str
    outcome: str
    running: bool


@dataclass(frozen=True, slots=True)
class StartedRun:
    """A run that the page has started, in a process of its own."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def failure(self) -> str:
        """Return why the run could not begin; empty while it may, or if it did."""
        if self.process.poll() in (None, 0) or (self.log.with_name(self.name) / RECORDING).exists():
            return ""
        return self.log.read_text(errors="replace").strip()[-500:] or "it ended without a message"

    def has_begun(self) -> None:
        """Leave the rest to the run folder, which has a log of its own."""
        self.log.unlink(missing_ok=True)


class Runs:
    """Folders below one root.

    Args:
        root: where runs leave their folders.
        cells: folder whose cell files may be started besides those that ship.
    """

    def __init__(self, root: Path, cells: Path) -> None:
        self.root = root
        self._cells = cells
        self._views: OrderedDict[tuple[str, str], RunView] = OrderedDict()
        self._started: list[StartedRun] = []

    def listed(self) -> list[ListedRun]:
        """Return the runs, the newest first."""
        if not self.root.is_dir():
            return []
        folders = [folder for folder in self.root.iterdir() if (folder / "cell.yaml").is_file()]
        folders.sort(key=lambda folder: (folder / "cell.yaml").stat().st_mtime_ns, reverse=True)
        return [ListedRun(folder.name, outcome(folder), is_running(folder)) for folder in folders[:_MOST_LISTED]]

    def folder(self, name: str) -> Path | None:
        """Return the folder of a run; None for a name that is none of them."""
        folder = self.root / name
        return folder if folder.parent == self.root and (folder / "cell.yaml").is_file() else None

    def has_begun(self, name: str) -> bool:
        """Whether a run records, or has."""
        folder = self.folder(name)
        return folder is not None and (folder / RECORDING).exists()

    def view(self, name: str, source: str = RECORDING) -> RunView | None:
        """Return the view of a run, which is read from now on; None for a name that is none of them.

        Args:
            name: of the run.
            source: its recording, or one of its black boxes.

        Raises:
            ConfigError: its cell file cannot be read.
        """
        folder = self.folder(name)
        if folder is None or (source != RECORDING and source not in sources(folder)):
            return None
        key = name, source
        view = self._views.get(key)
        if view is None:
            view = self._views[key] = RunView(folder, source)
            view.start()
        self._views.move_to_end(key)
        while len(self._views) > _MOST_VIEWS:
            self._views.popitem(last=False)[1].close()
        return view

    def stop(self, name: str, *, at_once: bool) -> str:
        """Ask a run to stop; returns what to show."""
        folder = self.folder(name)
        if folder is None:
            return "there is no such run"
        try:
            ask_to_stop(folder, at_once=at_once)
        except NoSuchRun as error:
            return str(error)
        return "asked to stop at once" if at_once else "asked to stop"

    def ask(self, name: str, request: OperatorRequest) -> str:
        """Ask a run that has tripped for a reset, or to resume; returns its answer."""
        folder = self.folder(name)
        if folder is None:
            return "there is no such run"
        return ask_run(folder, request, operator_name())[1]

    def cells(self) -> dict[str, Path]:
        """Return the cell files that may be started, by the name shown."""
        own = {path.name: path for path in sorted(self._cells.glob("*.yaml"))}
        shipped = {f"{path.stem} (ships with touchcell)": path for path in sorted(CONFIGS.glob("*.yaml"))}
        return {**own, **shipped}

    def start(self, cell: Path, more: Sequence[str] = (), *, by_hand: bool = False) -> StartedRun | str:
        """Start a run on simulated devices; returns why not where it cannot be started.

        Args:
            cell: the cell file.
            more: arguments of the command.
            by_hand: whether its arms are moved from the page, in place of its task.
        """
        self._started = [each for each in self._started if each.process.poll() is None]
        if len(self._started) >= _MOST_STARTED:
            return f"{_MOST_STARTED} runs that were started here are still in progress"
        self.root.mkdir(parents=True, exist_ok=True)
        name = f"{cell.stem}{'-jog' if by_hand else ''}-{datetime.now(UTC).astimezone():%Y%m%d-%H%M%S}"
        log = self.root / f".{name}.log"
        word = ["jog", str(cell), "--input", "page"] if by_hand else ["run", str(cell), "--quiet"]
        command = [sys.executable, "-m", "touchcell", *word, "--on", "sim"]
        command += ["--out", str(self.root / name), "--set", "recording.frames=jpeg", *more]
        with log.open("wb") as stream:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, start_new_session=True
            )
        started = StartedRun(name, process, log)
        self._started.append(started)
        return started

    def close(self) -> None:
        """Read nothing more; runs that were started continue."""
        for view in self._views.values():
            view.close()


def outcome(folder: Path) -> str:
    """Return how the run in a folder has ended; empty while it has not."""
    return str(read_record(folder / RESULT).get("outcome", ""))
