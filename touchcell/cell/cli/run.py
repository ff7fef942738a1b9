"""``touchcell run``: plan, compose, run within the operator's reach and with a live line, and report."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchcell.cell.analysis.report import write_report
from touchcell.cell.cli.exit_codes import EXIT_OK, EXIT_TASK_FAILED, EXIT_TRIPPED
from touchcell.cell.config.schema import CellPlan, plan_cell
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import RECORDING, Recorder
from touchcell.cell.runtime.black_box import BlackBox, cause_record, keep_earlier, note_crashes, stop_record
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.heap import trim_heap
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.operator_input import stop_on_keys, stop_on_signals
from touchcell.cell.runtime.run_directory import RunFolderError, run_directory
from touchcell.cell.runtime.run_result import Outcome, Progress, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.clock import VirtualClock

_EXIT = {
    Outcome.DONE: EXIT_OK,
    Outcome.STOPPED: EXIT_OK,
    Outcome.FAILED: EXIT_TASK_FAILED,
    Outcome.ERROR: EXIT_TASK_FAILED,
    Outcome.TRIPPED: EXIT_TRIPPED,
}


@dataclass(frozen=True)
class FinishedRun:
    """A run that has ended.

    Attributes:
        result: how it ended.
        folder: its run folder.
        summary: the text of its report.
    """

    result: RunResult
    folder: Path
    summary: str


def run_cell(
    path: Path,
    *,
    data: Path | None = None,
    model: str | None = None,
    out: Path | None = None,
    live: bool = True,
    moving: bool = False,
) -> int:
    """Run a cell file to its end and report; returns the exit code.

    Args:
        path: the cell file.
        data: for drivers that replay a data set.
        model: estimator model in place of the file's own.
        out: run folder, made for this run or empty.
        live: show a progress line.
        moving: also make the animation of a simulated run.

    Raises:
        ConfigError, ModelError, RunFolderError, ConnectError: before anything moves.
    """
    run = run_plan(plan_cell(path, {} if data is None else {"data": data}, model=model), out=out, live=live)
    print(run.summary)
    if moving:
        from touchcell.cell.experiments.animation import animate

        print(f"  {animate(run.folder).name}")
    if run.result.outcome not in (Outcome.DONE, Outcome.STOPPED):
        print(f"`touchcell why {run.folder}` explains")
    return _EXIT[run.result.outcome]


def run_plan(plan: CellPlan, *, out: Path | None = None, live: bool = False) -> FinishedRun:
    """Compose and run a planned cell to its end, and write its run folder.

    Args:
        plan: the cell.
        out: run folder, made for this run or empty; None for ``runs/NAME-TIME``.
        live: show a progress line.

    Raises:
        ConfigError, ModelError, RunFolderError, ConnectError: before anything moves.
    """
    cell = compose(plan)
    trim_heap()
    with run_directory(plan.cell.name, out) as folder:
        try:
            (folder / "cell.yaml").write_text(plan.text())
        except OSError as error:
            raise RunFolderError(folder, f"cannot be written: {error.strerror}") from None
        result = _run(cell, folder, live)
        try:
            (folder / "result.json").write_text(json.dumps(_result_json(plan, result), indent=1) + "\n")
        except OSError as error:
            print(f"touchcell: no result.json: {error.strerror}", file=sys.stderr)
    return FinishedRun(result, folder, _report(folder))


def _report(folder: Path) -> str:
    """Write the report; a disk without room for it keeps the recording, which the report is made from."""
    try:
        return write_report(folder)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            raise
        return f"no report: {error.strerror}; `touchcell report {folder}` makes it later"


def _run(cell: Cell, folder: Path, live: bool) -> RunResult:
    stop, channel = StopRequest(), OperatorChannel(folder)
    with (
        note_crashes(folder),
        BlackBox(folder, _about(cell, folder)) as box,
        _recording(folder) as recorder,
        cell,
        stop_on_signals(stop),
        stop_on_keys(stop, channel=channel) as look_at_keys,
        _live_line(cell.plan, live) as show,
    ):
        cell.watchdog.note_to(folder)
        if live:
            print("\n".join(cell.watchdog.describe()))

        def after_cycle(progress: Progress) -> None:
            look_at_keys()
            if show is not None:
                show(progress)
            if progress.waiting and isinstance(cell.clock, VirtualClock):
                # A person takes real time, whatever the cell's clock says.
                time.sleep(1.0 / cell.rate_hz)

        def tripped(so_far: RunResult) -> None:
            keep_earlier(folder)
            recorder.sync()
            _dump(box, folder, cell, so_far)
            print(f"tripped: {so_far.reason}\n`touchcell why {folder}` explains; `touchcell reset {folder}` or r, when")
            print("it is safe, then `touchcell resume` or g; `touchcell stop` or q ends the run")

        loop = RunLoop(cell, recorder, box=box, stop=stop, on_cycle=after_cycle, channel=channel, on_trip=tripped)
        result = loop.run()
        # Before the devices are given back, which an arm that obeys nothing may not survive.
        dumped = result.outcome is Outcome.DONE or loop.has_waited or _dump(box, folder, cell, result)
        if result.outcome is Outcome.TRIPPED:
            with contextlib.suppress(RecordingError):
                recorder.sync()
    if dumped:
        box.discard()
    return result


@contextlib.contextmanager
def _recording(folder: Path) -> Iterator[Recorder]:
    """The run's recording; one that cannot be finished changes nothing about how the run ended."""
    recorder = Recorder(folder / RECORDING)
    try:
        yield recorder
    finally:
        try:
            recorder.close()
        except RecordingError as error:
            print(f"touchcell: {error}", file=sys.stderr)


def _about(cell: Cell, folder: Path) -> dict[str, Any]:
    content = (folder / "cell.yaml").read_bytes()
    return {
        "cell": cell.plan.cell.name,
        "cell_file": "cell.yaml",
        "cell_sha256": hashlib.sha256(content).hexdigest(),
        "start_ns": cell.clock.now_ns(),
    }


def _dump(box: BlackBox, folder: Path, cell: Cell, result: RunResult) -> bool:
    """Write the black box; returns whether that succeeded. Its ring has everything where it did not."""
    try:
        box.dump(folder, result, cell.start_ns)
    except RecordingError as error:
        print(f"touchcell: {error}", file=sys.stderr)
        return False
    return True


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
            if progress.waiting:
                display.update(Text(f"{plan.cell.name}  {progress.waiting}"))
                return
            parts = [f"{plan.cell.name}  {progress.state:<10} t {progress.t_s:6.2f} s"]
            errors = [(name, value) for name, value in progress.telemetry.items() if "error_" in name]
            parts += [f"{name.replace('error_', '')} {value:+.2f}" for name, value in errors[:3]]
            parts.append(f"{progress.t_s / max(wall_s, 1e-3):.1f}x real time")
            if sys.stdin.isatty():
                parts.append("[space stops, q ends]")
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
        "stops": {role: stop_record(report) for role, report in result.stops.items()},
        "resets": [
            {"operator": reset.operator, "causes": [cause_record(cause) for cause in reset.causes]}
            for reset in result.resets
        ],
        "skipped": list(plan.skipped),
        "stages_us": {stage: _quantiles_us(rows) for stage, rows in result.times.rows.items()},
    }


def _quantiles_us(rows: Iterable[int]) -> dict[str, float]:
    ordered = sorted(rows)
    return {
        "median": round(ordered[len(ordered) // 2] * 1e-3, 1),
        "p99": round(ordered[min(len(ordered) - 1, round(0.99 * len(ordered)))] * 1e-3, 1),
        "count": len(ordered),
    }
