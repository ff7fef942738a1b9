"""``touchcell run``: plan, compose, run under signal handlers with a live line, and report."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cell.cli import EXIT_OK, EXIT_TASK_FAILED, EXIT_TRIPPED
from cell.compose import Cell, compose
from cell.config import CellPlan, plan_cell
from cell.loop import Outcome, Progress, RunLoop, RunResult, StopRequest
from cell.recording import Recorder
from cell.report import write_report

_EXIT = {
    Outcome.DONE: EXIT_OK,
    Outcome.STOPPED: EXIT_OK,
    Outcome.FAILED: EXIT_TASK_FAILED,
    Outcome.ERROR: EXIT_TASK_FAILED,
    Outcome.TRIPPED: EXIT_TRIPPED,
}


def run_cell(
    path: Path, *, data: Path | None = None, model: str | None = None, out: Path | None = None, live: bool = True
) -> int:
    """Run a cell file to its end and report; returns the exit code.

    Args:
        path: the cell file.
        data: for drivers that replay a data set.
        model: estimator model in place of the file's own.
        out: run folder.
        live: show a progress line.

    Raises:
        ConfigError, ModelError, ConnectError: before anything moves.
    """
    plan = plan_cell(path, {} if data is None else {"data": data}, model=model)
    cell = compose(plan)
    folder = out or Path("runs") / f"{plan.cell.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, folder / "cell.yaml")
    result = _run(cell, folder, live)
    (folder / "result.json").write_text(json.dumps(_result_json(plan, result), indent=1) + "\n")
    print(write_report(folder))
    return _EXIT[result.outcome]


def _run(cell: Cell, folder: Path, live: bool) -> RunResult:
    stop = StopRequest()
    with Recorder(folder / "run.mcap") as recorder, cell, _stop_on_signals(stop), _live_line(cell.plan, live) as show:
        return RunLoop(cell, recorder, stop=stop, on_cycle=show).run()


@contextlib.contextmanager
def _stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """The first Ctrl-C, SIGTERM or lost terminal ends the task in an orderly way, the second stops at once."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.ask()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _live_line(plan: CellPlan, live: bool) -> Iterator[Any]:
    if not live:
        yield None
        return
    from rich.live import Live
    from rich.text import Text

    started = time.monotonic()
    with Live(Text("starting"), refresh_per_second=8, transient=True) as display:

        def show(progress: Progress) -> None:
            wall_s = time.monotonic() - started
            parts = [f"{plan.cell.name}  {progress.state:<10} t {progress.t_s:6.2f} s"]
            errors = [item for item in progress.telemetry.items() if item[0].startswith("error_")]
            parts += [f"{name.removeprefix('error_')} {value:+.2f}" for name, value in errors[:3]]
            parts.append(f"{progress.t_s / max(wall_s, 1e-3):.1f}x real time")
            display.update(Text("  ".join(parts)))

        yield show


def _result_json(plan: CellPlan, result: RunResult) -> dict[str, Any]:
    return {
        "cell": plan.cell.name,
        "task": plan.task.name,
        "outcome": result.outcome.value,
        "reason": result.reason,
        "state": result.state,
        "duration_s": round(result.duration_s, 6),
        "cycles": result.cycles,
        "skipped": list(plan.skipped),
        "stages_us": {stage: _quantiles_us(rows) for stage, rows in result.times.rows.items()},
    }


def _quantiles_us(rows: list[int]) -> dict[str, float]:
    ordered = sorted(rows)
    return {
        "median": round(ordered[len(ordered) // 2] * 1e-3, 1),
        "p99": round(ordered[min(len(ordered) - 1, round(0.99 * len(ordered)))] * 1e-3, 1),
        "count": len(ordered),
    }
