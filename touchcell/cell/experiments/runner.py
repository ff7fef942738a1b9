"""``touchcell experiment``: definition of an experiment, and its execution from trials to table.

A trial is one run of a cell file with some keys changed. Each leaves a folder with its recording and ``trial.json``; an
experiment that is run again with the same settings runs only missing trials, so it may be interrupted at any time.
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
from touchcell.cell.experiments.executors import Workers
from touchcell.cell.experiments.run_trials import TrialsResult, perform_all
from touchcell.cell.experiments.table import Column, Row, table, to_json
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class Scale:
    """Amount of an experiment to run.

    Attributes:
        trials: repetitions of each row; None for the experiment's own number.
        quick: the smallest set that still contains every kind of row.
    """

    trials: int | None = None
    quick: bool = False

    def repetitions(self, usual: int) -> int:
        """Return the number of repetitions of a row that is usually repeated ``usual`` times."""
        if self.trials is not None:
            return self.trials
        return 1 if self.quick else usual


@dataclass(frozen=True, slots=True)
class ExperimentSpec:
    """An experiment's entry point (group ``touchcell.experiments``).

    Attributes:
        name: name on the command line.
        summary: one line for ``touchcell list``.
        trials: all trials at a scale; deterministic.
        measure: named numbers of a finished trial, from its ground truth.
        columns: measures that the table shows.
        draw: makes the figures from the finished trials, into a folder; returns them.
        paper: results of the paper, by row.
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


def run_experiment(
    experiment: ExperimentSpec,
    folder: Path,
    scale: Scale,
    *,
    workers: Workers | None = None,
    executor: str = "local",
    keep_stale: bool = False,
    live: bool = False,
    as_html: bool = False,
) -> TrialsResult:
    """Run missing trials, then write table and figures into ``folder``.

    The table marks kept trials that were run by other code.

    Args:
        experiment: its spec.
        folder: for ``trials/``, ``summary.txt``, ``summary.json`` and the figures.
        scale: amount of it.
        workers: how many trials at a time, and their limits; one without limits runs in this process.
        executor: name of what runs the trials, with ``:ADDRESS`` where it takes one.
        keep_stale: keep finished trials of other code, too.
        live: show progress.
        as_html: also write ``report.html``, whose plots are interactive.

    Raises:
        ConfigError: there is no such executor, or plotly is missing.
        WorkerDiffers: a worker elsewhere has other code.
        KeyboardInterrupt: every finished trial is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    perform = Perform(experiment.measure, folder / "trials", keep_stale=keep_stale)
    finished = perform_all(
        perform, experiment.trials(scale), workers=workers, executor=executor, live=live, title=experiment.name
    )
    rows, title = table_rows(finished), f"{experiment.name}: {experiment.summary}"
    text = table(title, rows, experiment.columns, experiment.paper)
    pictures = [] if any(each.broken for each in finished) else experiment.draw(finished, folder)
    lines = [
        text,
        *_troubles(finished),
        *stale_note(finished, perform),
        *experiment.notes,
        f"folder: {folder}",
        *(f"  {picture.name}" for picture in pictures),
    ]
    whole = "\n".join(lines)
    if as_html:
        # plotly is an extra.
        from touchcell.cell.experiments.html_report import write_experiment_html

        page = write_experiment_html(title, experiment.columns, finished, whole, pictures, folder)
        whole += f"\n  {page.name}"
    (folder / "summary.txt").write_text(whole + "\n")
    (folder / "summary.json").write_text(json.dumps(_summary(experiment, scale, rows, finished), indent=1) + "\n")
    return TrialsResult(whole, tuple(finished))


def stale_note(finished: Sequence[Finished], perform: Perform) -> list[str]:
    """Return which commits ran those of the trials that were not run by the code of today; empty if all were."""
    stale = Counter(each.commit for each in finished if each.digest != perform.code.digest)
    return [f"{count} of the trials were run by other code, commit {commit}" for commit, count in stale.items()]


def table_rows(finished: Sequence[Finished]) -> list[Row]:
    """Return the trials by row, in the order in which rows first appear."""
    by_row: dict[str, list[Finished]] = {}
    for each in finished:
        by_row.setdefault(each.trial.row, []).append(each)
    return [
        Row(name, tuple(each.measures for each in members), sum(each.done for each in members))
        for name, members in by_row.items()
    ]


def _troubles(finished: Sequence[Finished]) -> list[str]:
    """Return why trials did not finish, one line for each reason of a row."""
    lines = [f"{each.trial.row}: {each.outcome}: {each.reason}" for each in finished if not each.done]
    return [f"{line} ({count}x)" for line, count in Counter(lines).items()]


def _summary(
    experiment: ExperimentSpec, scale: Scale, rows: Sequence[Row], finished: Sequence[Finished]
) -> dict[str, Any]:
    return {
        **provenance(),
        "code": sorted({each.digest for each in finished}),
        "experiment": experiment.name,
        "trials": scale.trials,
        "quick": scale.quick,
        "rows": to_json(rows, experiment.columns, experiment.paper),
    }
