"""A sweep: trials of one cell at all combinations of its factors, their table, plots and worst cases."""

from __future__ import annotations

import csv
import fnmatch
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.provenance import provenance
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.experiments.executors import Workers
from touchcell.cell.experiments.run_trials import TrialsResult, perform_all
from touchcell.cell.experiments.runner import stale_note, table_rows
from touchcell.cell.experiments.table import Column, table
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.cell.sweeps.factors import Factors
from touchcell.cell.sweeps.measures import run_measures
from touchcell.errors import ConfigError, suggest

_WORST: Final = 3
_MOST_SHOWN: Final = 6


@dataclass(frozen=True, slots=True)
class Sweep:
    """What to run, and what to measure.

    Attributes:
        cell: the cell file.
        factors: what changes.
        measures: names of the numbers to show, with ``*``; empty for the first few.
        measure: named numbers of a finished trial; a function of a module, which workers can import.
        settings: values in place of the file's own in every trial, by dotted key.
    """

    cell: Path
    factors: Factors
    measures: tuple[str, ...] = ()
    measure: Callable[[RunFolder], Mapping[str, float]] = run_measures
    settings: Mapping[str, Any] | None = None

    def trials(self) -> list[Trial]:
        """Return all trials; those of one point of the grid are one row."""
        digits = len(str(max(len(self.factors) - 1, 0)))
        fixed = dict(self.settings or {})
        return [
            Trial(
                f"{number:0{digits}}",
                ", ".join(f"{_short(key)} {_text(value)}" for key, value in point.items()) or "all",
                str(self.cell.absolute()),
                {**fixed, **point, **sampled},
            )
            for number, (point, sampled) in enumerate(self.factors.points())
        ]


def run_sweep(
    sweep: Sweep,
    folder: Path,
    *,
    workers: Workers | None = None,
    executor: str = "local",
    keep_stale: bool = False,
    live: bool = False,
) -> TrialsResult:
    """Run the missing trials of a sweep, then write its tables and plots into ``folder``.

    ``sweep.csv`` has a row for each trial, ``sweep.parquet`` the same where pyarrow is installed, ``summary.txt``
    statistics at each point of the grid and the worst trials with the command that runs each again.

    Args:
        sweep: what to run.
        folder: for ``trials/``, tables and plots.
        workers: how many trials at a time, and their limits; one without limits runs in this process.
        executor: name of what runs the trials, with ``:ADDRESS`` where it takes one.
        keep_stale: keep finished trials of other code, too.
        live: show progress.

    Raises:
        ConfigError: no trial has a measure that was asked for, or there is no such executor.
        KeyboardInterrupt: every finished trial is kept.
    """
    from touchcell.cell.sweeps.plots import draw_factors

    folder.mkdir(parents=True, exist_ok=True)
    perform = Perform(sweep.measure, folder / "trials", keep_stale=keep_stale)
    finished = perform_all(
        perform, sweep.trials(), workers=workers, executor=executor, live=live, title=sweep.cell.stem
    )
    rows = _rows(finished, sweep.factors.keys)
    shown = _shown(sweep.measures, finished)
    written = [_write_csv(folder / "sweep.csv", rows), *_write_parquet(folder / "sweep.parquet", rows)]
    pictures = draw_factors(rows, sweep.factors.keys, shown, folder)
    columns = tuple(Column(name, name, digits=3) for name in shown)
    lines = [
        table(f"sweep of {sweep.cell.name}: {len(finished)} trials", table_rows(finished), columns, {}),
        *_worst(finished, shown, _WORST if sweep.measures else 1),
        *(f"{each.trial.name}: {each.outcome}: {each.reason}" for each in finished if each.broken),
        *_reasons(finished),
        *stale_note(finished, perform),
        f"folder: {folder}",
        *(f"  {path.name}" for path in (*written, *pictures)),
    ]
    text = "\n".join(lines)
    (folder / "summary.txt").write_text(text + "\n")
    (folder / "summary.json").write_text(json.dumps(_summary(sweep, finished), indent=1, default=str) + "\n")
    return TrialsResult(text, tuple(finished))


def _rows(finished: Sequence[Finished], keys: Sequence[str]) -> list[dict[str, Any]]:
    """Return one flat row for each trial: name, the values of ``keys``, outcome, reason, commit, and all measures."""
    return [
        {
            "trial": each.trial.name,
            **{key: each.trial.changes.get(key) for key in keys},
            "outcome": each.outcome,
            "reason": each.reason,
            "commit": each.commit,
            **each.measures,
        }
        for each in finished
    ]


def _shown(asked: Sequence[str], finished: Sequence[Finished]) -> list[str]:
    known = list(dict.fromkeys(name for each in finished for name in each.measures))
    if not asked:
        return known[:_MOST_SHOWN]
    shown: list[str] = []
    for pattern in asked:
        matching = [name for name in known if fnmatch.fnmatchcase(name, pattern)]
        if not matching and known:
            raise ConfigError(
                "no trial has such a measure", key="--measure", value=pattern, hint=suggest(pattern, known)
            )
        shown += [name for name in matching if name not in shown]
    return shown


def _worst(finished: Sequence[Finished], shown: Sequence[str], number: int) -> list[str]:
    lines = []
    for name in shown:
        having = [each for each in finished if name in each.measures]
        worst = sorted(having, key=lambda each: -abs(each.measures[name]))[:number]
        lines += [
            f"worst {name}: {each.measures[name]:.4g}: touchcell run {each.folder.path}/cell.yaml" for each in worst
        ]
    return lines


def _reasons(finished: Sequence[Finished]) -> list[str]:
    lines = [f"{each.outcome}: {each.reason}" for each in finished if not each.done and not each.broken]
    return [f"{line} ({count}x)" for line, count in Counter(lines).most_common(_MOST_SHOWN)]


def _summary(sweep: Sweep, finished: Sequence[Finished]) -> dict[str, Any]:
    return {
        **provenance(),
        "cell": str(sweep.cell),
        "keys": sweep.factors.keys,
        "trials": len(finished),
        "outcomes": dict(Counter(each.outcome for each in finished)),
        "code": sorted({each.digest for each in finished}),
        "means": {
            name: float(np.mean([each.measures[name] for each in finished if name in each.measures]))
            for name in dict.fromkeys(name for each in finished for name in each.measures)
        },
    }


def _write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path


def _write_parquet(path: Path, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        return []
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [row.get(name) for row in rows] for name in names}
    pyarrow.parquet.write_table(
        pyarrow.table({name: _uniform(values) for name, values in columns.items()}), path, compression="zstd"
    )
    return [path]


def _uniform(values: Sequence[Any]) -> list[Any]:
    """Return a column of one type: numbers, truth values or text."""
    present = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in present):
        return list(values)
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in present):
        return [None if value is None else float(value) for value in values]
    return [None if value is None else _text(value) for value in values]


def _short(key: str) -> str:
    return key.rpartition(".")[2]


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
