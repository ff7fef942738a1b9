"""Trials: runs of cell files with some keys changed, in parallel processes, kept once they have finished."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import yaml

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome
from touchcell.errors import ConfigError, suggest
from touchcell.paths import CONFIGS
from touchcell.registry import Registry

COLLECTED = "data"
"""Subfolder of a trial's folder for collected frames."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of an experiment.

    Attributes:
        name: its folder; unique within an experiment.
        row: the row of the table that it belongs to.
        cell: a cell file, among the shipped ones unless it is a path.
        changes: values in place of the file's own, by dotted key ("task.depth_mm").
    """

    name: str
    row: str
    cell: str
    changes: Mapping[str, Any] = field(default_factory=dict)

    def cell_data(self) -> dict[str, Any]:
        """Return the whole cell file with the changes. Raises ConfigError for a key whose section does not exist."""
        path = Path(self.cell)
        data: dict[str, Any] = yaml.safe_load((path if path.is_absolute() else CONFIGS / path).read_text())
        data = copy.deepcopy(data)
        for key, value in self.changes.items():
            *way, leaf = key.split(".")
            section = data
            for word in way:
                if not isinstance(section.get(word), dict):
                    raise ConfigError("no such section", file=self.cell, key=key, hint=suggest(word, list(section)))
                section = section[word]
            section[leaf] = copy.deepcopy(value)
        return data


@dataclass(frozen=True, slots=True)
class Finished:
    """A finished trial.

    Attributes:
        trial: the trial.
        folder: its run folder.
        outcome: value of ``touchcell.cell.runtime.loop.Outcome``.
        reason: reason of the outcome.
        measures: named numbers.
    """

    trial: Trial
    folder: RunFolder
    outcome: str
    reason: str
    measures: Mapping[str, float]

    @property
    def done(self) -> bool:
        """True if the task finished."""
        return self.outcome == Outcome.DONE.value


@dataclass(frozen=True, slots=True)
class Perform:
    """Runs trials into ``root``; picklable, to be passed to other processes.

    Attributes:
        measure: named numbers of a finished trial.
        root: holds one folder for each trial.
    """

    measure: Callable[[RunFolder], Mapping[str, float]]
    root: Path

    def __call__(self, trial: Trial) -> Finished:
        """Run a trial and measure it; mark it as finished last."""
        started = time.perf_counter()
        folder = self.root / trial.name
        folder.mkdir(parents=True, exist_ok=True)
        marker = folder / "trial.json"
        marker.unlink(missing_ok=True)
        data = trial.cell_data()
        settings = _digest(data)
        if "collect" in data:
            data["collect"]["data"] = str(folder / COLLECTED)
        (folder / "cell.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
        cell = compose(plan_cell(folder / "cell.yaml"))
        with Recorder(folder / "run.mcap") as recorder, cell:
            result = RunLoop(cell, recorder).run()
        measures = self.measure(RunFolder(folder)) if result.cycles else {}
        record = {
            "settings": settings,
            "outcome": result.outcome.value,
            "reason": result.reason,
            "duration_s": result.duration_s,
            "wall_s": round(time.perf_counter() - started, 3),
            # Measures that are not finite are left out, as JSON has no number for them.
            "measures": {name: float(value) for name, value in measures.items() if math.isfinite(value)},
        }
        _write_whole(marker, json.dumps(record, indent=1))
        # A new RunFolder: the measured one holds its whole recording in memory.
        return _finished(trial, RunFolder(folder), record)

    def kept(self, trial: Trial) -> Finished | None:
        """Return the trial's result from an earlier run of the experiment, if it had the same settings."""
        folder = self.root / trial.name
        try:
            record = json.loads((folder / "trial.json").read_text())
        except (OSError, ValueError):
            return None
        return _finished(trial, RunFolder(folder), record) if record["settings"] == _digest(trial.cell_data()) else None


class Executor(Protocol):
    """Runs trials somewhere: in processes of this machine, or on others."""

    def __call__(self, perform: Perform, trials: Sequence[Trial], jobs: int, /) -> Iterator[Finished]:
        """Run every trial by ``perform(trial)``, at most ``jobs`` at a time; yield each as it finishes, in any order.

        Closing the iterator, or an interrupt, ends what runs.
        """
        ...


@dataclass(frozen=True, slots=True)
class ExecutorSpec:
    """Entry point of an executor (group ``touchcell.executors``).

    Attributes:
        name: value of ``--executor`` on the command line.
        summary: one line for ``touchcell list``.
        run: the executor.
    """

    name: str
    summary: str
    run: Executor


EXECUTORS: Final = Registry("touchcell.executors", "executor", ExecutorSpec)
"""All installed executors."""


def perform_all(
    perform: Perform,
    trials: Sequence[Trial],
    *,
    jobs: int = 1,
    executor: str = "local",
    live: bool = False,
    title: str = "",
) -> list[Finished]:
    """Run the missing ones of ``trials``; return all of them in order.

    Args:
        perform: runs one.
        trials: all trials.
        jobs: number in parallel; 1 runs them in this process.
        executor: name of what runs them.
        live: show a progress bar.
        title: on it.

    Raises:
        KeyboardInterrupt: running trials are ended; finished ones are kept.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    found = {trial.name: kept for trial in trials if (kept := perform.kept(trial)) is not None}
    missing = [trial for trial in trials if trial.name not in found]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True, disable=not live) as progress:
        bar = progress.add_task(title, total=len(trials), completed=len(found))
        for finished in EXECUTORS.load(executor).run(perform, missing, jobs):
            found[finished.trial.name] = finished
            progress.update(bar, advance=1, description=f"{title}: {finished.trial.name} {finished.outcome}")
    return [found[trial.name] for trial in trials]


def _finished(trial: Trial, folder: RunFolder, record: Mapping[str, Any]) -> Finished:
    return Finished(trial, folder, record["outcome"], record["reason"], record["measures"])


def _digest(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _write_whole(path: Path, text: str) -> None:
    unfinished = path.with_suffix(".unfinished")
    try:
        unfinished.write_text(text + "\n")
        os.replace(unfinished, path)
    except OSError as error:
        raise RecordingError(path, f"cannot be written: {error.strerror}") from None
