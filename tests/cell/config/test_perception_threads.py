"""Where a cell perceives: what is chosen by itself, by the file, and never for simulated cameras; ``check`` tells."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.perception_threads import perception_line, threaded_sensors
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome
from touchcell.drivers.core.clock import VirtualClock
from touchcell.paths import CONFIGS

_NETWORK = {"kind": "network", "model": "builtin:sim_gdn"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(6):
        cv2.imwrite(str(tmp_path / f"frame_{i}.png"), np.full((480, 640), 90, np.uint8))
    return tmp_path


def observing(folder: Path, **changes: object) -> CellPlan:
    camera = {"driver": "replay_camera", "data": str(folder), "rate_hz": 60.0, "estimator": _NETWORK}
    cell = {
        "schema": 1,
        "name": "observing",
        "time": "real",
        "rate_hz": 100,
        "sensors": {"sensor": camera},
        "task": {"name": "observe"},
        **changes,
    }
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(cell))
    return plan_cell(path)


@pytest.mark.parametrize(
    ("sensors", "changes", "threaded"),
    [
        (1, {}, True),
        (4, {}, True),
        (1, {"rate_hz": 50}, False),
        (2, {"rate_hz": 50}, True),
        (4, {"perceive_in": "loop"}, False),
        (1, {"perceive_in": "threads"}, True),
        (4, {"time": "simulated"}, False),
        (4, {"time": "simulated", "perceive_in": "threads"}, False),
    ],
)
def test_threads_are_taken_where_a_cycle_does_not_hold_the_frames(
    folder: Path, sensors: int, changes: dict[str, object], *, threaded: bool
) -> None:
    plan = observing(folder, **changes)
    names = [f"sensor_{i}" for i in range(sensors)]
    cell = plan.cell.model_copy(update={"sensors": dict.fromkeys(names, plan.cell.sensors["sensor"])})
    found = threaded_sensors(cell, dict.fromkeys(names, plan.sensors["sensor"]))
    assert found == (set(names) if threaded else set())


@pytest.mark.parametrize(("pace", "threaded"), [(1.0, True), (0.5, False)])
def test_an_emulated_world_that_runs_slower_leaves_more_time(folder: Path, pace: float, *, threaded: bool) -> None:
    plan = observing(folder)
    cell = plan.cell.model_copy(update={"world": "emulated", "emulated_pace": pace})
    assert bool(threaded_sensors(cell, plan.sensors)) == threaded


@pytest.mark.parametrize("perceive_in", ["auto", "threads"])
def test_a_simulated_camera_stays_in_the_loop_even_in_real_time(perceive_in: str) -> None:
    settings = {"time": "real", "rate_hz": 500, "perceive_in": perceive_in}
    plan = plan_cell(CONFIGS / "surface_follow_sim.yaml", settings=settings)
    assert threaded_sensors(plan.cell, plan.sensors) == frozenset()
    assert perception_line(plan) == "in the loop's thread, as cameras or time are simulated"


def test_a_sensor_that_reads_no_frames_counts_for_nothing() -> None:
    plan = plan_cell(
        CONFIGS / "surface_follow_sim.yaml", settings={"sensors.sensor.estimator": {"kind": "true_contact"}}
    )
    assert threaded_sensors(plan.cell, plan.sensors) == frozenset()
    assert perception_line(plan) == ""


def test_check_says_where(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for changes, told in (
        ({"rate_hz": 50}, "in the loop's thread: 1 frame of 6 ms, no more than half of a cycle of 20 ms"),
        ({}, "in a thread for each sensor: 1 frame of 6 ms, more than half of a cycle of 10 ms"),
        ({"rate_hz": 50, "perceive_in": "threads"}, "in a thread for each sensor, as perceive_in says"),
    ):
        observing(folder, **changes)
        assert main(["check", str(folder / "cell.yaml")]) == EXIT_OK
        assert f"  perceives {told}\n" in capsys.readouterr().out


def test_a_clock_of_the_callers_is_not_waited_for_in_a_thread(folder: Path) -> None:
    plan = observing(folder, perceive_in="threads")
    assert compose(plan).sensors["sensor"].threaded
    assert not compose(plan, clock=VirtualClock()).sensors["sensor"].threaded


def test_a_run_ends_its_threads(folder: Path) -> None:
    before = threading.active_count()
    names: set[str] = set()
    with compose(observing(folder, perceive_in="threads")) as cell:
        watch = {"on_cycle": lambda _: names.update(thread.name for thread in threading.enumerate())}
        result = RunLoop(cell, None, **watch).run()  # type: ignore[arg-type]
    assert result.outcome is Outcome.DONE, result.reason
    assert "perceives sensor" in names
    assert threading.active_count() == before
