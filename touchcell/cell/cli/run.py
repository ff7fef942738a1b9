"""``touchcell run``: plan, compose, run within the operator's reach and with a live line, and report."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from touchcell.cell.analysis.report import write_report
from touchcell.cell.cli.exit_codes import EXIT_DEVICE_LOST, EXIT_OK, EXIT_TASK_FAILED, EXIT_TRIPPED
from touchcell.cell.cli.output import say, warn
from touchcell.cell.cli.run_description import describe_run, wall_clock_ns
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.recording.reserved_file import ReservedFile
from touchcell.cell.runtime.black_box import BlackBox, keep_earlier, note_crashes
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.heap import trim_heap
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.operator_input import stop_on_keys, stop_on_signals
from touchcell.cell.runtime.result_record import RESULT, not_started_record, result_record
from touchcell.cell.runtime.run_directory import RunFolderError, run_directory
from touchcell.cell.runtime.run_result import Outcome, Progress, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.worlds import cell_in_world
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.jog import JogInput
from touchcell.errors import TouchcellError
from touchcell.logs import log_to_file

logger = logging.getLogger(__name__)

LOG = "run.log"
"""Name of the log file in a run folder."""

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
        summary: the text of its report; empty where none could be written.
        leaving: what was raised after the run, while its devices were given back or its recording was closed.
    """

    result: RunResult
    folder: Path
    summary: str
    leaving: Exception | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of ``touchcell run``."""
        if self.result.lost or isinstance(self.leaving, DeviceError):
            return EXIT_DEVICE_LOST
        code = _EXIT[self.result.outcome]
        return EXIT_TASK_FAILED if code == EXIT_OK and self.leaving is not None else code


def run_cell(
    path: Path,
    *,
    data: Path | None = None,
    model: str | None = None,
    world: WorldName | None = None,
    settings: Mapping[str, Any] | None = None,
    out: Path | None = None,
    live: bool = True,
    moving: bool = False,
    live_port: int | None = None,
    page_port: int | None = None,
) -> int:
    """Run a cell file to its end and report; returns the exit code.

    Args:
        path: the cell file.
        data: for drivers that replay a data set.
        model: estimator model in place of the file's own.
        world: where it runs; None as the file is written.
        settings: values in place of the file's own, by dotted key.
        out: run folder, made for this run or empty.
        live: show a progress line.
        moving: also make the animation of a simulated run.
        live_port: of a server for Foxglove on this machine; None serves nothing.
        page_port: of the operator's page on this machine; None serves none.

    Raises:
        ConfigError, ModelError, RunFolderError, ConnectError: before anything moves.
    """
    overrides = {} if data is None else {"data": data}
    with cell_in_world(path, world, overrides, model=model, settings=settings) as plan:
        for note in plan.notes:
            say(note if world is None else f"on {world}: {note}")
        for problem in plan.foreseen:
            warn(f"each run would trip: {problem}")
        run = run_plan(plan, out=out, live=live, live_port=live_port, page_port=page_port)
    end_of_run(run, moving=moving)
    return run.exit_code


def end_of_run(run: FinishedRun, *, moving: bool = False) -> None:
    """Show the report of a run that has ended, and how it ended."""
    if run.summary:
        say(run.summary)
    if moving:
        from touchcell.cell.experiments.animation import animate

        say(f"  {animate(run.folder).name}")
    if run.result.outcome is not Outcome.DONE:
        say(f"{run.result.outcome.value}: {run.result.reason or 'no reason was given'}")
    if run.result.outcome not in (Outcome.DONE, Outcome.STOPPED):
        say(f"`touchcell why {run.folder}` explains")


class RunOperator(Protocol):
    """The operator's end of a run, in place of the keys and the line of ``touchcell run``."""

    @property
    def jog_input(self) -> JogInput | None:
        """What an operator who moves the arms by hand asks for."""
        ...

    def attend(
        self, cell: Cell, folder: Path, stop: StopRequest, channel: OperatorChannel, live: bool
    ) -> AbstractContextManager[Callable[[Progress], None]]:
        """Read the operator's input within the context; gives what is called after each cycle."""
        ...


def run_plan(
    plan: CellPlan,
    *,
    out: Path | None = None,
    live: bool = False,
    live_port: int | None = None,
    page_port: int | None = None,
    operator: RunOperator | None = None,
) -> FinishedRun:
    """Compose and run a planned cell to its end, and write its run folder.

    Args:
        plan: the cell.
        out: run folder, made for this run or empty; None for ``runs/NAME-TIME``.
        live: show a progress line.
        live_port: of a server for Foxglove on this machine; None serves nothing.
        page_port: of the operator's page on this machine; None serves none.
        operator: see ``RunOperator``; None for the keys of ``touchcell run``.

    Raises:
        ConfigError, ModelError, RunFolderError, ConnectError: before anything moves.
    """
    operator = operator or KeysAndLine()
    cell = compose(plan, jog_input=operator.jog_input)
    trim_heap()
    with run_directory(plan.cell.name, out) as folder, _log_and_result(folder, plan) as result_file:
        logger.info("%s: task %s of %s, in %s", plan.cell.name, plan.task.name, plan.file, folder)
        try:
            with _page(folder, page_port, moves=operator.jog_input is not None):
                result, leaving = _run(cell, folder, live, result_file, live_port, operator)
        except Exception as error:
            _write_result(result_file, not_started_record(plan, error))
            raise
        ended = f"{result.outcome.value} after {result.duration_s:.2f} s"
        logger.info("%s: %s%s", plan.cell.name, ended, f" ({result.reason})" if result.reason else "")
    return FinishedRun(result, folder, _report(folder), leaving)


def _page(folder: Path, port: int | None, *, moves: bool) -> AbstractContextManager[None]:
    """The operator's page, from a process of its own."""
    if port is None:
        return contextlib.nullcontext()
    from touchcell.cell.ui.beside import page_beside

    return page_beside(folder.absolute(), port, moves=moves)


@contextlib.contextmanager
def _log_and_result(folder: Path, plan: CellPlan) -> Iterator[ReservedFile]:
    """Put the cell file and a log into the run folder, and take the room for ``result.json``."""
    try:
        (folder / "cell.yaml").write_text(plan.text())
        result_file = ReservedFile(folder / RESULT)
    except OSError as error:
        raise RunFolderError(folder, f"cannot be written: {error.strerror}") from None
    with log_to_file(folder / LOG):
        try:
            yield result_file
        finally:
            result_file.discard()


def _report(folder: Path) -> str:
    """Write the report; without room for it, or with a recording that is damaged, there is none."""
    try:
        return write_report(folder)
    except (OSError, TouchcellError) as error:
        warn(f"no report: {error}; `touchcell report {folder}` makes it later")
        return ""


def _run(
    cell: Cell,
    folder: Path,
    live: bool,
    result_file: ReservedFile,
    live_port: int | None,
    operator: RunOperator,
) -> tuple[RunResult, Exception | None]:
    """Run to the end; returns how it ended, and what was raised when the devices were given back."""
    result = None
    try:
        with _running(cell, folder, live, result_file, live_port, operator) as run:
            result = run()
    except Exception as error:
        if result is None:
            raise
        logger.exception("after the run")
        warn(f"after the run: {error}")
        _write_result(result_file, {**result_record(cell.plan, result), "after_the_run": str(error)})
        return result, error
    return result, None


@contextlib.contextmanager
def _running(
    cell: Cell,
    folder: Path,
    live: bool,
    result_file: ReservedFile,
    live_port: int | None,
    operator: RunOperator,
) -> Iterator[Callable[[], RunResult]]:
    """Within reach of the operator, with everything open and all devices active; yields what runs the task."""
    stop, channel = StopRequest(), OperatorChannel(folder)
    explained = False
    with (
        note_crashes(folder),
        BlackBox(folder, _about(cell, folder)) as box,
        _recorder(folder, cell) as recorder,
        _served(recorder, cell, live_port),
        cell,
        stop_on_signals(stop),
        operator.attend(cell, folder, stop, channel, live) as attend,
    ):
        cell.watchdog.note_to(folder)
        if live:
            say("\n".join(cell.watchdog.describe()))

        def after_cycle(progress: Progress) -> None:
            attend(progress)
            if progress.waiting and isinstance(cell.clock, VirtualClock):
                # A person takes real time, whatever the cell's clock says.
                time.sleep(1.0 / cell.rate_hz)

        def tripped(so_far: RunResult) -> None:
            keep_earlier(folder)
            recorder.sync()
            _dump(box, folder, cell, so_far)
            say(f"tripped: {so_far.reason}\n`touchcell why {folder}` explains; `touchcell reset {folder}` or r, when")
            say("it is safe, then `touchcell resume` or g; `touchcell stop` or q ends the run")

        loop = RunLoop(cell, recorder, box=box, stop=stop, on_cycle=after_cycle, channel=channel, on_trip=tripped)

        def run() -> RunResult:
            result = loop.run()
            # Before the devices are given back, which an arm that obeys nothing may not survive.
            _write_result(result_file, result_record(cell.plan, result))
            nonlocal explained
            explained = result.outcome is Outcome.DONE or loop.has_waited or _dump(box, folder, cell, result)
            if result.outcome is Outcome.TRIPPED:
                recorder.sync()
            return result

        yield run
    if explained:
        box.discard()


class KeysAndLine:
    """The keys that stop, reset and resume, and the progress line."""

    jog_input: JogInput | None = None

    @contextlib.contextmanager
    def attend(
        self, cell: Cell, folder: Path, stop: StopRequest, channel: OperatorChannel, live: bool
    ) -> Iterator[Callable[[Progress], None]]:
        """Read the keys within the context; yields what is called after each cycle."""
        with stop_on_keys(stop, channel=channel) as look_at_keys, _live_line(cell.plan, live) as show:

            def after_cycle(progress: Progress) -> None:
                look_at_keys()
                if show is not None:
                    show(progress)

            yield after_cycle


@contextlib.contextmanager
def _recorder(folder: Path, cell: Cell) -> Iterator[Recorder]:
    with Recorder(folder / RECORDING, wall_offset_ns=wall_clock_ns() - cell.clock.now_ns()) as recorder:
        describe_run(recorder, cell)
        yield recorder


@contextlib.contextmanager
def _served(recorder: Recorder, cell: Cell, port: int | None) -> Iterator[None]:
    """Serve what is recorded to viewers on this machine."""
    if port is None:
        yield
        return
    with recorder.serve(cell.plan.cell.name, port) as address:
        say(f"live: {address} (Foxglove or Lichtblick: Open connection, Foxglove WebSocket)")
        yield


def _about(cell: Cell, folder: Path) -> dict[str, Any]:
    return {
        "cell": cell.plan.cell.name,
        "cell_file": "cell.yaml",
        "cell_sha256": hashlib.sha256((folder / "cell.yaml").read_bytes()).hexdigest(),
        "start_ns": cell.clock.now_ns(),
    }


def _dump(box: BlackBox, folder: Path, cell: Cell, result: RunResult) -> bool:
    """Write the black box; returns whether that succeeded. Its ring has everything where it did not."""
    try:
        box.dump(folder, result, cell.start_ns)
    except Exception as error:
        logger.info("no black box but its ring", exc_info=True)
        # What happened is reported all the same.
        warn(f"the black box stays in its ring: {error}")
        return False
    return True


def _write_result(result_file: ReservedFile, result: Mapping[str, Any]) -> None:
    try:
        result_file.write(json.dumps(result, indent=1) + "\n")
    except OSError as error:
        warn(f"no result.json: {error}")


@contextlib.contextmanager
def _live_line(plan: CellPlan, live: bool) -> Iterator[Any]:
    if not live:
        yield None
        return
    from rich.live import Live
    from rich.text import Text

    started = time.monotonic()
    display = Live(Text("starting"), refresh_per_second=8, transient=True)
    try:
        display.start()

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
    finally:
        # A terminal that is gone needs no last line.
        with contextlib.suppress(OSError, ValueError):
            display.stop()
