"""An experiment's table: one row per kind of trial, statistics over its trials, and the paper's figures beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Column:
    """One measure in the table.

    Attributes:
        measure: its name.
        title: column header, with the unit.
        statistic: over the trials of a row. ``mean`` shows the standard deviation as well, ``count`` the number that
            were
            not zero.
        digits: after the decimal point.
        below: limit for the worst trial; None where there is none.
    """

    measure: str
    title: str
    statistic: Literal["mean", "worst", "count"] = "mean"
    digits: int = 2
    below: float | None = None

    def values(self, row: Row) -> Array:
        """Return the measure in every trial that has it."""
        found = np.array([trial.get(self.measure, np.nan) for trial in row.measures], dtype=np.float64)
        return found[np.isfinite(found)]

    def text(self, row: Row) -> str:
        """Return the text of the cell; a ``!`` marks a missed limit."""
        values = self.values(row)
        if not len(values):
            return "-"
        missed = "!" if self.below is not None and values.max() >= self.below else ""
        return _TEXTS[self.statistic](values, self.digits) + missed


@dataclass(frozen=True, slots=True)
class Row:
    """The trials of one row.

    Attributes:
        name: in the first column.
        measures: of each trial.
        done: number of trials whose task finished.
    """

    name: str
    measures: tuple[Mapping[str, float], ...]
    done: int


def table(title: str, rows: Sequence[Row], columns: Sequence[Column], paper: Mapping[str, str]) -> str:
    """Return the table as text."""
    head = ["", "done", *(column.title for column in columns)] + (["paper"] if paper else [])
    lines = [head]
    for row in rows:
        cells = [row.name, f"{row.done}/{len(row.measures)}", *(column.text(row) for column in columns)]
        lines.append(cells + ([paper.get(row.name, "")] if paper else []))
    aims = [f"< {column.below:g}" if column.below is not None else "" for column in columns]
    if any(aims):
        lines.append(["aim", "", *aims] + ([""] if paper else []))
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    text = [title] + [
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width) for i, (cell, width) in _with(line, widths)
        ).rstrip()
        for line in lines
    ]
    if any(cell.endswith("!") for line in lines for cell in line):
        text.append("! misses its limit in at least one trial")
    return "\n".join(text)


def to_json(rows: Sequence[Row], columns: Sequence[Column], paper: Mapping[str, str]) -> dict[str, Any]:
    """Return the table as JSON data, with every trial's value."""
    return {
        row.name: {
            "trials": len(row.measures),
            "done": row.done,
            "paper": paper.get(row.name),
            **{column.measure: _statistics(column.values(row)) for column in columns},
        }
        for row in rows
    }


def _with(line: Sequence[str], widths: Sequence[int]) -> list[tuple[int, tuple[str, int]]]:
    return list(enumerate(zip(line, widths, strict=True)))


def _statistics(values: Array) -> dict[str, Any]:
    if not len(values):
        return {"values": []}
    return {"mean": float(values.mean()), "sd": _sd(values), "worst": float(values.max()), "values": values.tolist()}


def _sd(values: NDArray[np.float64]) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


def _mean(values: Array, digits: int) -> str:
    spread = f" ± {_sd(values):.{digits}f}" if len(values) > 1 else ""
    return f"{values.mean():.{digits}f}{spread}"


def _worst(values: Array, digits: int) -> str:
    return f"{values.max():.{digits}f}"


def _count(values: Array, digits: int) -> str:
    return f"{np.count_nonzero(values)} of {len(values)}"


_TEXTS: dict[str, Callable[[Array, int], str]] = {"mean": _mean, "worst": _worst, "count": _count}
