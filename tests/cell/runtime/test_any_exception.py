"""Whatever is raised wherever: every arm is told to stop in the same moment, and the run ends in a result."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.helpers.pushing_cell import cell_file
from tests.helpers.sampling import sampled
from touchcell.cell.cli import run as run_command
from touchcell.cell.cli.exit_codes import EXIT_DEVICE_LOST, EXIT_TASK_FAILED, EXIT_TRIPPED
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.black_box import BlackBox
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, Progress
from touchcell.cell.runtime.run_states import RunState
from touchcell.drivers.core.errors import DeviceFault, DeviceGone
from touchcell.drivers.core.protocols import StopCategory


class Unspeakable(Exception):
    """Raises when it is asked what it says."""

    def __repr__(self) -> str:
        raise RuntimeError("no words")

    __str__ = __repr__


EXCEPTIONS: dict[str, Callable[[], BaseException]] = {
    "OSError": lambda: OSError(errno.EPIPE, "broken pipe"),
    "ValueError": lambda: ValueError("a value"),
    "MemoryError": lambda: MemoryError(),
    "RecursionError": lambda: RecursionError("too deep"),
    "SystemExit": lambda: SystemExit(0),
    "KeyboardInterrupt": KeyboardInterrupt,
    "GeneratorExit": GeneratorExit,
    "unspeakable": Unspeakable,
    "DeviceFault": lambda: DeviceFault("leader", "it complains"),
    "DeviceGone": lambda: DeviceGone("leader", "unplugged"),
    "RecordingError": lambda: RecordingError(Path("run.mcap"), "cannot be written"),
}


class Raises:
    """Replaces a method: does as it did until it is armed, then raises."""

    def __init__(self, owner: Any, method: str, error: BaseException) -> None:
        self._was, self._error = getattr(owner, method), error
        self.armed = False
        object.__setattr__(owner, method, self)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if self.armed:
            raise self._error
        return self._was(*arguments, **named)


class Replaced:
    """Replaces one rule of a supervisor by one that raises."""

    def __init__(self, cell: Cell, error: BaseException) -> None:
        self.armed = False
        self.name, self._error = "broken", error
        supervisor: Any = cell.supervisor
        supervisor._rules = (*supervisor._rules, self)

    def check(self, view: Any) -> None:
        if self.armed:
            raise self._error


PLACES: dict[str, Callable[[Cell, Recorder, BlackBox, BaseException], Any]] = {
    "a driver's stop": lambda cell, recorder, box, error: Raises(cell.arms["leader"], "stop", error),
    "a driver's state": lambda cell, recorder, box, error: Raises(cell.arms["leader"], "tcp", error),
    "a driver's at_rest": lambda cell, recorder, box, error: Raises(cell.arms["leader"], "at_rest", error),
    "a driver's send": lambda cell, recorder, box, error: Raises(cell.arms["leader"], "send_twist", error),
    "a driver's release": lambda cell, recorder, box, error: Raises(cell.arms["leader"], "release", error),
    "a sensor": lambda cell, recorder, box, error: Raises(cell.sensors["leader_sensor"].source, "update", error),
    "the task's tick": lambda cell, recorder, box, error: Raises(cell.task, "tick", error),
    "the task's trip": lambda cell, recorder, box, error: Raises(cell.task, "trip", error),
    "an interlock": lambda cell, recorder, box, error: Replaced(cell, error),
    "the supervisor": lambda cell, recorder, box, error: Raises(cell.supervisor, "review", error),
    "the recorder": lambda cell, recorder, box, error: Raises(recorder, "write_encoded", error),
    "the black box": lambda cell, recorder, box, error: Raises(box, "add", error),
    "the scene": lambda cell, recorder, box, error: Raises(cell.scene, "objects", error),
    "the watchdog's beat": lambda cell, recorder, box, error: Raises(cell.watchdog, "beat", error),
    "the watchdog's alarms": lambda cell, recorder, box, error: Raises(cell.watchdog, "alarms", error),
    "the watchdog's end": lambda cell, recorder, box, error: Raises(cell.watchdog, "end", error),
}
HARMLESS = {
    "a driver's release",
    "the black box",
    "the watchdog's end",
    "a driver's at_rest",
    "a driver's stop",
    "the task's trip",
}
"""Places that are not passed, or that do no harm, as long as nothing else goes wrong."""


class Stops:
    """When each arm was told to stop from outside the cycle's own work."""

    def __init__(self, cell: Cell, loop: RunLoop) -> None:
        self.at_ns: dict[str, list[int]] = {role: [] for role in cell.arms}
        for role, arm in cell.arms.items():
            self._watch(role, arm, cell, loop)

    def _watch(self, role: str, arm: Any, cell: Cell, loop: RunLoop) -> None:
        stop = arm.stop

        def stopped(category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
            if loop.state is RunState.STOPPING:
                self.at_ns[role].append(cell.clock.now_ns())
            stop(category)

        arm.stop = stopped


def moving(cell: Cell, loop: RunLoop) -> None:
    for _ in range(600):
        assert loop.step()
        if all(arm._body.velocity.any() for arm in cell.arms.values()):
            return
    raise AssertionError("the arms do not move")


@pytest.fixture(scope="module")
def cell_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cell") / "cell.yaml"
    path.write_text(yaml.safe_dump(cell_file("dual_push_sim.yaml")))
    return path


@pytest.mark.parametrize(("place", "kind"), sampled(product(PLACES, EXCEPTIONS), 2 * len(PLACES) + 1))
def test_an_exception_stops_every_arm_in_the_same_moment(
    tmp_path: Path, cell_path: Path, place: str, kind: str
) -> None:
    cell = compose(plan_cell(cell_path))
    box = BlackBox()
    with cell, Recorder(tmp_path / "run.mcap") as recorder:
        fault = PLACES[place](cell, recorder, box, EXCEPTIONS[kind]())
        loop = RunLoop(cell, recorder, box=box)
        stops = Stops(cell, loop)
        moving(cell, loop)
        fault.armed = True
        going = True
        for _ in range(3):
            going = going and loop.step()
        assert going == (place in HARMLESS)
        if going:
            # What else may go wrong then: an arm that tells nonsense.
            cell.arms["follower"].tcp = lambda *_: _raise(DeviceGone("follower", "unplugged"))
            assert not loop.step()
        result = loop.end()
        assert result.outcome in (Outcome.TRIPPED, Outcome.ERROR)
        assert result.reason
        told = {role: times[0] for role, times in stops.at_ns.items()}
        assert told.keys() == cell.arms.keys()
        assert len(set(told.values())) == 1
        for role, arm in cell.arms.items():
            assert result.stops[role].problem or result.stops[role].time_s is not None
            if (place, role) != ("a driver's stop", "leader"):
                assert not arm._body.velocity.any(), f"{role} still moves"
            if (place, role) != ("a driver's release", "leader"):
                assert arm.owner is None
        fault.armed = False


@pytest.mark.parametrize(
    ("place", "kind"),
    sampled(
        product([place for place in PLACES if place not in HARMLESS], ["ValueError", "DeviceGone", "SystemExit"]), 11
    ),
)
def test_the_command_leaves_a_result_a_black_box_and_the_right_exit_code(
    tmp_path: Path, cell_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, kind: str
) -> None:
    class Armed(RunLoop):
        def __init__(self, cell: Cell, recorder: Any, *, box: Any = None, on_cycle: Any = None, **more: Any) -> None:
            fault = PLACES[place](cell, recorder, box, EXCEPTIONS[kind]())

            def after_cycle(progress: Progress) -> None:
                on_cycle(progress)
                fault.armed = progress.t_s > 0.2

            super().__init__(cell, recorder, box=box, on_cycle=after_cycle, **more)

    monkeypatch.setattr(run_command, "RunLoop", Armed)
    code = run_command.run_cell(cell_path, out=tmp_path / "run", live=False)
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    box = json.loads((tmp_path / "run" / "blackbox.json").read_text())
    # An arm that cannot be read is not seen at rest, which is a trip of its own.
    trips = place in ("an interlock", "a driver's state")
    assert result["outcome"] == box["outcome"] == ("tripped" if trips else "error")
    assert result["reason"] == box["reason"] != ""
    lost = kind == "DeviceGone" and place != "an interlock" and place != "the recorder"
    assert code == (EXIT_DEVICE_LOST if lost else EXIT_TRIPPED if trips else EXIT_TASK_FAILED)


def _raise(error: BaseException) -> None:
    raise error
