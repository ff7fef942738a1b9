"""Cell files: load one, change a value, run it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell


@dataclass(frozen=True)
class CellRun:
    """A run that has ended.

    Attributes:
        cell: name of the cell.
        outcome: "done", "failed", "stopped", "tripped" or "error".
        reason: in one sentence; may be empty when the task simply finished.
        state: the task's last state.
        duration_s: cell time from start to end.
        folder: run folder, for ``read_run``.
        summary: text of its report.
    """

    cell: str
    outcome: str
    reason: str
    state: str
    duration_s: float
    folder: Path
    summary: str

    @property
    def done(self) -> bool:
        """Whether the task did what it promises."""
        return self.outcome == "done"

    def __repr__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        return f"<CellRun {self.cell!r}: {self.outcome}{why} after {self.duration_s:.2f} s, in {self.folder}>"


def load_cell(
    path: str | PathLike[str],
    *,
    set: Mapping[str, Any] | None = None,
    data: str | PathLike[str] | None = None,
    model: str | None = None,
) -> CellPlan:
    """Read and check a cell file without connecting anything.

        cell = tc.load_cell("surface_follow_sim", set={"task.speed_mm_s": 10})

    Args:
        path: a cell file, or the name of one that ships ("surface_follow_sim").
        set: values in place of the file's own, by dotted key.
        data: data set folder for drivers that replay one.
        model: estimator model in place of the one that the file names.

    Raises:
        ConfigError: with file, line, key, value and remedy; InvalidCell for several mistakes at once.
    """
    overrides = {} if data is None else {"data": Path(data)}
    return plan_cell(find_cell(Path(path)), overrides, model=model, settings=set)


def run(cell: str | PathLike[str] | CellPlan, *, out: str | PathLike[str] | None = None, live: bool = False) -> CellRun:
    """Run a cell's task to its end, write its run folder, and return how it ended.

    What devices, data or disk do ends in a ``CellRun`` with the arms stopped, never in an exception. Ctrl-C ends the
    task in an orderly way; a second one stops at once.

    Args:
        cell: a cell file, the name of one that ships, or what ``load_cell`` returned.
        out: run folder; None for ``runs/NAME-TIME``.
        live: show a progress line.

    Raises:
        ConfigError, ModelError, ConnectError: before anything moves.
    """
    from touchcell.cell.cli.run import run_plan

    plan = cell if isinstance(cell, CellPlan) else load_cell(cell)
    ended = run_plan(plan, out=None if out is None else Path(out), live=live)
    result = ended.result
    return CellRun(
        plan.cell.name,
        result.outcome.value,
        result.reason,
        result.state,
        result.duration_s,
        ended.folder,
        ended.summary,
    )
