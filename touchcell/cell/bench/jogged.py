"""A cell that is jogged by a scripted operator, the same in every world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from touchcell.cell.config.jog_plan import jog_settings
from touchcell.cell.config.settings import parse_settings
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.worlds import cell_in_world
from touchcell.drivers.core.jog import AT_REST, Axes, JogFrame, JogMode, JogRequest
from touchcell.drivers.core.samples import Stamped

_UP: Final = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_ASIDE: Final = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_DOWN: Final = (0.0, 0.0, -1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Held:
    """What the operator holds, and until when.

    Attributes:
        until_s: after the operator's first look at the cell; then comes the next, or the end.
        mode, axes, share: of the request; let go where the axes are at rest and the mode is free.
    """

    until_s: float
    mode: JogMode = JogMode.FREE
    axes: Axes = AT_REST
    share: float = 1.0


SCRIPT: Final = (
    Held(0.5),
    Held(1.5, JogMode.FREE, _UP, 0.2),
    Held(2.0),
    Held(3.5, JogMode.FREE, _ASIDE, 0.2),
    Held(4.0),
    Held(9.0, JogMode.UNTIL_TOUCH, _DOWN),
    Held(9.5),
    Held(12.0, JogMode.RETRACT),
    Held(12.5),
)
"""Up, aside, down until it touches, and away; it lets go between them, and then asks for the end."""


class ScriptedOperator:
    """Jog input that follows a script, in the cell's own time.

    Args:
        arm: role of the arm that it moves.
        stop: asked at the end of the script.
        script: what is held, in order.
    """

    def __init__(self, arm: str, stop: StopRequest, script: Sequence[Held] = SCRIPT) -> None:
        self._arm = arm
        self._stop = stop
        self._script = script
        self._began_ns: int | None = None

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        """Return what is held now; see ``JogInput``."""
        if self._began_ns is None:
            self._began_ns = now_ns
        t_s = 1e-9 * (now_ns - self._began_ns)
        seq, held = next(((k, each) for k, each in enumerate(self._script) if t_s < each.until_s), (0, None))
        if held is None:
            if not self._stop.orderly:
                self._stop.ask()
            return None
        if held.mode is JogMode.FREE and held.axes == AT_REST:
            return None
        return Stamped(JogRequest(self._arm, held.mode, held.axes, JogFrame.BASE, held.share), now_ns, seq)


def jog_run(path: Path, world: WorldName, folder: Path, settings: Sequence[str] = ()) -> RunResult:
    """Jog a cell through the script, and record it in ``folder``.

    Args:
        path: the cell file.
        world: where it runs.
        folder: for the recording.
        settings: ``KEY=VALUE``, in place of the file's own.

    Raises:
        ConfigError: the file is not valid, or has no arm that can be moved.
        ConnectError, TransportTimeout: an emulator does not start.
    """
    own, _ = jog_settings(path, world, parse_settings(settings))
    stop = StopRequest()
    with cell_in_world(path, world, settings=own) as plan, Recorder(folder / RECORDING) as recorder:
        operator = ScriptedOperator(next(iter(plan.arm_roles)), stop)
        with compose(plan, jog_input=operator) as cell:
            return RunLoop(cell, recorder, stop=stop).run()
