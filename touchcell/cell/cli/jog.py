"""``touchcell jog``: move a cell's arms by hand from a terminal, and save poses into its file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from touchcell.cell.cli.output import say
from touchcell.cell.cli.run import RunOperator, end_of_run, run_plan
from touchcell.cell.config.jog_plan import jog_settings
from touchcell.cell.config.teach import Teacher
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.jog_keyboard import HELP, JogKeyboard
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.operator_input import terminal_keys
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.worlds import cell_in_world, plan_for
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.jog import JogInput, JogRequest
from touchcell.drivers.core.samples import Stamped
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry.types import Array


def jog_cell(
    path: Path,
    *,
    world: WorldName | None = None,
    settings: Mapping[str, Any] | None = None,
    speed_mm_s: float,
    turn_deg_s: float,
    out: Path | None = None,
    live_port: int | None = None,
) -> int:
    """Move the arms of a cell by hand until the operator ends it; returns the exit code.

    Args:
        path: the cell file.
        world: where it runs; None as the file is written.
        settings: values in place of the file's own, by dotted key.
        speed_mm_s, turn_deg_s: largest speeds.
        out: run folder, made for this run or empty.
        live_port: of a server for Foxglove on this machine; None serves nothing.

    Raises:
        ConfigError: standard input is no terminal, the file is not valid, or it has no arm that can be moved.
        ModelError, RunFolderError, ConnectError: before anything moves.
    """
    with terminal_keys(sys.stdin) as read:
        if read is None:
            raise ConfigError(
                "jog reads the keys of a terminal, and there is none", key="standard input", hint="run it in one"
            )
    own, notes = jog_settings(path, world, settings, speed_mm_s=speed_mm_s, turn_deg_s=turn_deg_s)
    with cell_in_world(path, world, settings=own) as plan:
        for note in (*notes, *(f"on {world}: {note}" for note in plan.notes)):
            say(note)
        say("\n".join(HELP))

        def check(changes: Mapping[str, Any]) -> object:
            return plan_for(path, world, settings={**changes, **(settings or {})})

        teacher = Teacher(path, plan, check)
        run = run_plan(plan, out=out, live=True, live_port=live_port, operator=JogConsole(teacher))
    end_of_run(run)
    return run.exit_code


class JogConsole(RunOperator):
    """The terminal of a run that is moved by hand.

    Args:
        teacher: saves poses.
    """

    def __init__(self, teacher: Teacher) -> None:
        self._teacher = teacher
        self._keyboard: JogKeyboard | None = None

    @property
    def jog_input(self) -> JogInput:
        """What the task reads: the keyboard, once it is attended."""
        return _Attended(lambda: self._keyboard)

    @contextmanager
    def attend(
        self, cell: Cell, stop: StopRequest, channel: OperatorChannel, live: bool
    ) -> Iterator[Callable[[Progress], None]]:
        """Read keys and show where the arm is, within the context; yields what is called after each cycle."""
        saving: list[Future[str]] = []
        with terminal_keys(sys.stdin) as read, ThreadPoolExecutor(1) as pool, _status(live) as show:

            def save(arm: str, name: str) -> str:
                if saving and not saving[0].done():
                    return "still saving"
                pose = cell.arms[arm].tcp().value.T_base_tcp.copy()
                # Checking the file takes longer than a control cycle may.
                saving[:] = [pool.submit(_saved, self._teacher, arm, name, pose)]
                return f"saving {name} ..."

            keyboard = JogKeyboard(read or _gone, list(cell.plan.arm_roles), stop, channel, save)
            self._keyboard = keyboard
            started_s, pace = time.monotonic(), isinstance(cell.clock, VirtualClock)

            def after_cycle(progress: Progress) -> None:
                if progress.waiting:
                    # No task asks for the keys then.
                    keyboard.request(cell.clock.now_ns())
                if saving and saving[0].done():
                    keyboard.message = saving.pop().result()
                show(_lines(cell, keyboard, progress))
                if pace:
                    # A person takes real time, whatever the cell's clock says.
                    ahead_s = progress.t_s - (time.monotonic() - started_s)
                    time.sleep(min(max(ahead_s, 0.0), 1.0))

            try:
                yield after_cycle
            finally:
                self._keyboard = None


class _Attended:
    """Jog input that asks nothing while no terminal is attended."""

    def __init__(self, keyboard: Callable[[], JogKeyboard | None]) -> None:
        self._keyboard = keyboard

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        """Return what the keyboard asks for, if there is one."""
        keyboard = self._keyboard()
        return None if keyboard is None else keyboard.request(now_ns)


def _gone() -> bytes | None:
    return None


def _saved(teacher: Teacher, arm: str, name: str, pose: Array) -> str:
    try:
        return f"saved {teacher.save(arm, name, pose)}"
    except TouchcellError as error:
        return f"not saved: {error}"


def _lines(cell: Cell, keyboard: JogKeyboard, progress: Progress) -> str:
    if progress.waiting:
        return progress.waiting
    values = progress.telemetry
    arm = keyboard.settings.arm
    prefix = f"{arm}_" if len(cell.plan.arm_roles) > 1 else ""
    pose = [
        f"{name.partition('_')[0]} {values[prefix + name]:.2f}"
        for name in ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
        if prefix + name in values
    ]
    depths = [
        f"{name.removesuffix('_depth_mm')} pressed in {value:.2f} mm"
        for name, value in values.items()
        if name.endswith("_depth_mm")
    ]
    last = cell.task.transitions[-1:] if progress.state == "release" else ()
    why = "; ".join(record.reason for record in last if record.reason)
    first = f"{progress.state.replace('_', ' '):<12} {keyboard.settings.describe()}"
    let_go = "let go of the key" if progress.state == "release" else ""
    third = "  ".join(filter(None, (keyboard.prompt, keyboard.message, why, let_go)))
    return "\n".join((first, "  ".join((*pose, *depths)), third))


@contextmanager
def _status(live: bool) -> Iterator[Callable[[str], None]]:
    if not live:
        with nullcontext():
            yield lambda text: None
        return
    from rich.live import Live
    from rich.text import Text

    display = Live(Text("starting"), refresh_per_second=10, transient=True)
    try:
        display.start()
        yield lambda text: display.update(Text(text))
    finally:
        # A terminal that is gone needs no last line.
        with suppress(OSError, ValueError):
            display.stop()
