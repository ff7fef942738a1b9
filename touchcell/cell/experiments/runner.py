"""``touchcell experiment``: what an experiment is, and how it is run from its trials to its table.

A trial is one run of a cell file with some keys changed. Each leaves a folder with its recording and ``trial.json``; an
experiment that is run again with the same settings does only what is missing, so that it may be broken off at any time.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from touchcell.cell.analysis.provenance import provenance
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.experiments.table import Column, Row, table, to_json
from touchcell.cell.experiments.trials import Finished, Perform, Trial, perform_all
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class Scale:
    """How much of an experiment to do.

    Attributes:
        trials: repetitions of each row; None for as many as the experiment has by itself.
        quick: the smallest share that still shows every kind of row.
    """

    trials: int | None = None
    quick: bool = False

    def repetitions(self, usual: int) -> int:
        """How often to repeat a row that is usually repeated ``usual`` times."""
        if self.trials is not None:
            return self.trials
        return 1 if self.quick else usual


@dataclass(frozen=True, slots=True)
class ExperimentSpec:
    """An experiment's entry point (group ``touchcell.experiments``).

    Attributes:
        name: the word on the command line.
        summary: one line for ``touchcell list``.
        trials: all trials at a scale; the same for the same scale.
        measure: named numbers of a trial that has run, from what was true in it.
        columns: which of them the table shows.
        draw: makes the pictures from the trials that have finished, into a folder; returns them.
        paper: what the paper reports, by row.
        notes: lines below the table.
    """

    name: str
    summary: str
    trials: Callable[[Scale], Sequence[Trial]]
    measure: Callable[[RunFolder], Mapping[str, float]]
    columns: tuple[Column, ...]
    draw: Callable[[Sequence[Finished], Path], Sequence[Path]]
    paper: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


EXPERIMENTS: Final = Registry("touchcell.experiments", "experiment", ExperimentSpec)
"""All installed experiments."""


def run_experiment(experiment: ExperimentSpec, folder: Path, scale: Scale, *, jobs: int = 1, live: bool = False) -> str:
    """Do what is missing, then write table and pictures into ``folder``; returns the table.

    Args:
        experiment: which.
        folder: for ``trials/``, ``summary.txt``, ``summary.json`` and the pictures.
        scale: how much of it.
        jobs: trials at a time, each in a process of its own; 1 stays in this one.
        live: show progress.

    Raises:
        ConfigError: a trial's cell file makes no sense.
        KeyboardInterrupt: every trial that had finished is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    perform = Perform(experiment.measure, folder / "trials")
    finished = perform_all(perform, experiment.trials(scale), jobs=jobs, live=live, title=experiment.name)
    rows = _rows(finished)
    text = table(f"{experiment.name}: {experiment.summary}", rows, experiment.columns, experiment.paper)
    pictures = experiment.draw(finished, folder)
    lines = [
        text,
        *_troubles(finished),
        *experiment.notes,
        f"folder: {folder}",
        *(f"  {picture.name}" for picture in pictures),
    ]
    whole = "\n".join(lines)
    (folder / "summary.txt").write_text(whole + "\n")
    (folder / "summary.json").write_text(json.dumps(_summary(experiment, scale, rows), indent=1) + "\n")
    return whole


def _rows(finished: Sequence[Finished]) -> list[Row]:
    by_row: dict[str, list[Finished]] = {}
    for each in finished:
        by_row.setdefault(each.trial.row, []).append(each)
    return [
        Row(name, tuple(each.measures for each in members), sum(each.done for each in members))
        for name, members in by_row.items()
    ]


def _troubles(finished: Sequence[Finished]) -> list[str]:
    """Why trials did not come to their end, one line for each reason of a row."""
    lines = [f"{each.trial.row}: {each.outcome}: {each.reason}" for each in finished if not each.done]
    return [f"{line} ({count}x)" for line, count in Counter(lines).items()]


def _summary(experiment: ExperimentSpec, scale: Scale, rows: Sequence[Row]) -> dict[str, Any]:
    return {
        **provenance(),
        "experiment": experiment.name,
        "trials": scale.trials,
        "quick": scale.quick,
        "rows": to_json(rows, experiment.columns, experiment.paper),
    }
