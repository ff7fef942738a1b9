"""``touchcell jog``: move a cell's arms by hand from a terminal, a page or a gamepad, and save poses into its file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, Final

from touchcell.cell.cli.output import say
from touchcell.cell.cli.run import RunOperator, end_of_run, run_plan
from touchcell.cell.config.jog_plan import jog_settings
from touchcell.cell.config.teach import Teacher
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.hand_device import devices_read
from touchcell.cell.runtime.jog_channel import JogChannel, JogInputs
from touchcell.cell.runtime.jog_keyboard import HELP, JogKeyboard
from touchcell.cell.runtime.operator_channel import OperatorChannel
from touchcell.cell.runtime.operator_input import terminal_keys
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.worlds import cell_in_world, plan_for
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.jog import HAND_DEVICES, JogInput, JogRequest
from touchcell.drivers.core.samples import Stamped
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry.types import Array

PAGE: Final = "page"
"""Input by an operator's page that is served elsewhere."""
_SHOWN_S: Final = 0.1


def jog_cell(
    path: Path,
    *,
    world: WorldName | None = None,
    settings: Mapping[str, Any] | None = None,
    speed_mm_s: float,
    turn_deg_s: float,
    out: Path | None = None,
    live_port: int | None = None,
    inputs: Sequence[str] = (),
    page_port: int | None = None,
) -> int:
    """Move the arms of a cell by hand until the operator ends it; returns the exit code.

    Args:
        path: the cell file.
        world: where it runs; None as the file is written.
        settings: values in place of the file's own, by dotted key.
        speed_mm_s, turn_deg_s: largest speeds.
        out: run folder, made for this run or empty.
        live_port: of a server for Foxglove on this machine; None serves nothing.
        inputs: names of input devices besides the keys; ``PAGE`` is an operator's page that is served elsewhere.
        page_port: of the operator's page on this machine, which moves the arms too; None serves none.

    Raises:
        ConfigError: nothing could move the arms, the file is not valid, or it has no arm that can be moved.
        ModelError, RunFolderError, ConnectError: before anything moves.
    """
    devices = [name for name in inputs if name != PAGE]
    for name in devices:
        HAND_DEVICES.load(name)
    with terminal_keys(sys.stdin) as read:
        if read is None and not inputs and page_port is None:
            hint = "run it in one, or with --ui or --input"
            raise ConfigError("jog reads the keys of a terminal, and there is none", key="standard input", hint=hint)
        has_terminal = read is not None
    own, notes = jog_settings(path, world, settings, speed_mm_s=speed_mm_s, turn_deg_s=turn_deg_s)
    with cell_in_world(path, world, settings=own) as plan:
        for note in (*notes, *(note if world is None else f"on {world}: {note}" for note in plan.notes)):
            say(note)
        if has_terminal:
            say("\n".join(HELP))

        def check(changes: Mapping[str, Any]) -> object:
            return plan_for(path, world, settings={**changes, **(settings or {})})

        teacher = Teacher(path, plan, check)
        console = JogConsole(teacher, devices, from_outside=bool(inputs) or page_port is not None)
        run = run_plan(plan, out=out, live=True, live_port=live_port, page_port=page_port, operator=console)
    end_of_run(run)
    return run.exit_code


class JogConsole(RunOperator):
    """The operator's end of a run that is moved by hand.

    Args:
        teacher: saves poses.
        devices: names of input devices, each read in a process of its own.
        from_outside: whether other processes may move the arms: the page, and those of ``devices``.
    """

    def __init__(self, teacher: Teacher, devices: Sequence[str] = (), *, from_outside: bool = False) -> None:
        self._teacher = teacher
        self._devices = devices
        self._from_outside = from_outside
        self._inputs: JogInputs | None = None

    @property
    def jog_input(self) -> JogInput:
        """What the task reads: all inputs, once they are attended."""
        return _Attended(lambda: self._inputs)

    @contextmanager
    def attend(
        self, cell: Cell, folder: Path, stop: StopRequest, channel: OperatorChannel, live: bool
    ) -> Iterator[Callable[[Progress], None]]:
        """Read the inputs and show where the arm is, within the context; yields what is called after each cycle."""
        saving: list[Future[str]] = []
        arms = list(cell.plan.arm_roles)
        with ExitStack() as stack:
            read = stack.enter_context(terminal_keys(sys.stdin))
            pool = stack.enter_context(ThreadPoolExecutor(1))
            show = stack.enter_context(_status(live and read is not None))

            def save(arm: str, name: str) -> str:
                if arm not in cell.arms:
                    return f"there is no arm {arm!r}"
                if saving and not saving[0].done():
                    return "still saving"
                pose = cell.arms[arm].tcp().value.T_base_tcp.copy()
                # Checking the file takes longer than a control cycle may.
                saving[:] = [pool.submit(_saved, self._teacher, arm, name, pose)]
                return f"saving {name} ..."

            keyboard = JogKeyboard(read or _gone, arms, stop, channel, save)
            outside = stack.enter_context(JogChannel(folder, stop, save)) if self._from_outside else None
            stack.enter_context(devices_read(self._devices, folder, arms))
            self._inputs = inputs = JogInputs(keyboard if read is not None else None, outside)
            started_s, pace = time.monotonic(), isinstance(cell.clock, VirtualClock)
            shown_s = 0.0

            def after_cycle(progress: Progress) -> None:
                nonlocal shown_s
                if progress.waiting:
                    # No task asks for the keys then.
                    inputs.request(cell.clock.now_ns())
                if saving and saving[0].done():
                    keyboard.message = saving.pop().result()
                    if outside is not None:
                        outside.message = keyboard.message
                show(_lines(cell, keyboard, progress))
                if outside is not None and progress.t_s - shown_s >= _SHOWN_S:
                    shown_s = progress.t_s
                    outside.show(_shown(cell, progress, outside.message))
                if pace:
                    # A person takes real time, whatever the cell's clock says.
                    ahead_s = progress.t_s - (time.monotonic() - started_s)
                    time.sleep(min(max(ahead_s, 0.0), 1.0))

            try:
                yield after_cycle
            finally:
                self._inputs = None


class _Attended:
    """Jog input that asks nothing while no operator is attended."""

    def __init__(self, inputs: Callable[[], JogInput | None]) -> None:
        self._inputs = inputs

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        """Return what is asked for, if there is anything to ask."""
        inputs = self._inputs()
        return None if inputs is None else inputs.request(now_ns)


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
    first = f"{progress.state.replace('_', ' '):<12} {keyboard.settings.describe()}"
    where = _where(cell, progress, keyboard.settings.arm)
    third = "  ".join(filter(None, (keyboard.prompt, keyboard.message, _reason(cell, progress))))
    return "\n".join((first, where, third))


def _where(cell: Cell, progress: Progress, arm: str) -> str:
    """Return the pose of an arm's tool, and how deep its sensors are pressed in."""
    values = progress.telemetry
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
    return "  ".join((*pose, *depths))


def _reason(cell: Cell, progress: Progress) -> str:
    """Return why the arm stands although it was asked to move."""
    if progress.state != "release":
        return ""
    reasons = (record.reason for record in cell.task.transitions[-1:] if record.reason)
    return "  ".join((*reasons, "let go of the key"))


def _shown(cell: Cell, progress: Progress, message: str) -> dict[str, object]:
    """Return what a page shows beside its buttons."""
    return {
        "state": "tripped" if progress.waiting else progress.state,
        "reason": progress.waiting or _reason(cell, progress),
        "where": {arm: _where(cell, progress, arm) for arm in cell.plan.arm_roles},
        "message": message,
    }


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
