"""A run that has tripped waits for a person: refused with a reason, reset once per trip, and never a motion by it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.helpers.operated_run import OperatedRun, tripped, waiting_cell
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_TASK_FAILED
from touchcell.cell.cli.main import main
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.cell.runtime.operator_channel import OperatorRequest, is_waiting
from touchcell.cell.runtime.run_result import Outcome
from touchcell.cell.runtime.watchdog import NullWatchdog
from touchcell.control.latch import LatchState
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import DeviceFault
from touchcell.geometry.types import Array

DEADLINE_S = 60.0


def test_reset_then_resume_starts_the_task_from_its_first_state_and_it_ends_well(tmp_path: Path) -> None:
    run = tripped(tmp_path)
    assert [trip.outcome for trip in run.trips] == [Outcome.TRIPPED]
    assert run.trips[0].stops["arm"].kept
    run.go(5)
    assert "cause is still there" in run.waiting
    assert run.ask(OperatorRequest.RESET) == "refused: a cause is still present"
    run.fault(stale=False)
    run.go(2)
    assert run.cell.supervisor.latch.state is LatchState.CAUSE_GONE
    assert "r resets" in run.waiting
    assert run.ask(OperatorRequest.RESUME) == "refused: reset first"
    stood = run.pose()
    assert run.ask(OperatorRequest.RESET).startswith("reset; nothing moves")
    assert run.ask(OperatorRequest.RESET) == "refused: nothing is latched"
    run.go(200)
    np.testing.assert_array_equal(run.pose(), stood)
    assert run.cell.task.state == "tripped"
    first = run.cell.task
    assert "starts again" in run.ask(OperatorRequest.RESUME)
    assert run.cell.task is not first
    assert run.cell.task.state == "prepare"
    run.go(2000)
    result = run.end()
    assert result.outcome is Outcome.DONE
    assert [(reset.operator, reset.causes[0].interlock) for reset in result.resets] == [("ada", "stale_arm")]


def test_without_the_key_in_the_file_a_trip_ends_the_run_as_ever(tmp_path: Path) -> None:
    run = OperatedRun(tmp_path, waiting_cell(on_trip="end"))
    run.until("run")
    run.fault(stale=True)
    run.go(50)
    assert not run.going
    assert run.end().outcome is Outcome.TRIPPED
    assert run.trips == []


def test_without_anybody_to_ask_a_trip_ends_the_run(tmp_path: Path) -> None:
    run = OperatedRun(tmp_path, operated=False)
    run.until("run")
    run.fault(stale=True)
    run.go(50)
    assert not run.going
    assert run.end().outcome is Outcome.TRIPPED


def test_what_was_asked_before_the_trip_counts_for_nothing(tmp_path: Path) -> None:
    run = OperatedRun(tmp_path)
    run.until("run")
    run.channel.ask(OperatorRequest.RESET, "ada")
    run.channel.ask(OperatorRequest.RESUME, "ada")
    run.fault(stale=True)
    run.until("tripped")
    run.fault(stale=False)
    run.go(50)
    assert run.cell.supervisor.latch.state is LatchState.CAUSE_GONE
    assert run.cell.task.state == "tripped"
    assert run.end().outcome is Outcome.TRIPPED


def test_an_arm_that_moves_while_it_waits_is_stopped_again_by_stronger_means(tmp_path: Path) -> None:
    run = tripped(tmp_path)
    run.fault(stale=False)
    run.go(2)
    run.fault(drift_m_s=0.005)
    # Told to stand it sinks; stopped by its strongest category it closes its brakes.
    run.go(2)
    assert run.arm.state is Lifecycle.READY
    assert [cause.interlock for cause in run.cell.supervisor.latch.causes] == ["stale_arm", "stop"]
    stood = run.pose()
    run.go(50)
    np.testing.assert_array_equal(run.pose(), stood)
    run.fault(drift_m_s=0.0)
    run.go(5)
    assert run.ask(OperatorRequest.RESET).startswith("reset")
    assert "starts again" in run.ask(OperatorRequest.RESUME)
    assert run.arm.state is Lifecycle.ACTIVE
    run.go(2000)
    assert run.end().outcome is Outcome.DONE


def test_category_1_takes_the_power_and_resume_gives_it_back(tmp_path: Path) -> None:
    cell = waiting_cell()
    cell["arms"]["arm"]["stop_category"] = 1
    run = OperatedRun(tmp_path, cell)
    run.until("run")
    run.fault(stale=True)
    run.until("tripped")
    assert run.arm.state is Lifecycle.READY
    run.fault(stale=False)
    run.go(2)
    assert run.ask(OperatorRequest.RESET).startswith("reset")
    assert run.arm.state is Lifecycle.READY
    assert "starts again" in run.ask(OperatorRequest.RESUME)
    assert run.arm.state is Lifecycle.ACTIVE
    run.go(2000)
    assert run.end().outcome is Outcome.DONE


def test_a_device_fault_waits_too_and_a_reset_recovers_the_device(tmp_path: Path) -> None:
    run = OperatedRun(tmp_path)
    run.until("run")
    run.arm._to_faulted(DeviceFault("arm", "it complains"))
    run.until("tripped")
    causes = run.cell.supervisor.latch.causes
    assert [(cause.interlock, cause.subject) for cause in causes] == [("device", "arm")]
    run.go(3)
    assert run.arm.state is Lifecycle.FAULTED
    assert run.ask(OperatorRequest.RESET).startswith("reset")
    assert run.arm.state is Lifecycle.READY
    assert "starts again" in run.ask(OperatorRequest.RESUME)
    run.go(2000)
    assert run.end().outcome is Outcome.DONE


def test_a_second_trip_needs_a_second_reset(tmp_path: Path) -> None:
    run = tripped(tmp_path)
    run.fault(stale=False)
    run.go(2)
    run.ask(OperatorRequest.RESET)
    run.fault(stale=True)
    run.go(20)
    assert run.cell.supervisor.latch.state is LatchState.TRIPPED
    assert run.ask(OperatorRequest.RESUME) == "refused: reset first"
    run.fault(stale=False)
    run.go(2)
    assert run.ask(OperatorRequest.RESET).startswith("reset")
    run.ask(OperatorRequest.RESUME)
    run.go(2000)
    result = run.end()
    assert (result.outcome, len(result.resets)) == (Outcome.DONE, 2)


def test_a_stop_ends_the_waiting_and_time_spent_in_it_does_not_count(tmp_path: Path) -> None:
    run = tripped(tmp_path, max_duration_s=6.0)
    run.fault(stale=False)
    run.go(600)
    run.ask(OperatorRequest.RESET)
    run.ask(OperatorRequest.RESUME)
    run.go(50)
    assert run.going
    run.fault(stale=True)
    run.until("tripped")
    run.stop.ask()
    run.go(1)
    assert not run.going
    assert run.end().outcome is Outcome.TRIPPED


class NotedWatch(NullWatchdog):
    """Writes down when it is told to guard and when not."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def begin(self) -> None:
        self.told.append("begin")

    def end(self) -> None:
        self.told.append("end")


def test_nobody_guards_while_it_waits_so_that_no_arm_obeys(tmp_path: Path) -> None:
    run = tripped(tmp_path)
    watch = run.cell.watchdog = NotedWatch()
    run.fault(stale=False)
    run.go(2)
    run.ask(OperatorRequest.RESET)
    assert watch.told == []
    run.ask(OperatorRequest.RESUME)
    assert watch.told == ["begin"]
    run.go(5)
    run.fault(stale=True)
    run.until("tripped")
    assert watch.told == ["begin", "end"]
    run.end()


class Impatient(RuleBasedStateMachine):
    """Any order of faults, resets and resumes: between a trip and a resume after its reset, nothing is commanded."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()

    @initialize(category=st.sampled_from([1, 2]))
    def start(self, category: int) -> None:
        cell = waiting_cell(max_duration_s=100.0)
        cell["arms"]["arm"]["stop_category"] = category
        cell["task"]["distance_mm"] = 400
        self.run = OperatedRun(Path(self.folder.name), cell)
        self.allowed = True
        follow = self.run.arm._body.follow

        def watched(twist: Array, expires_ns: int) -> None:
            assert self.allowed, "a command between trip and resume"
            follow(twist, expires_ns)

        self.run.arm._body.follow = watched  # type: ignore[method-assign]

    @rule(cycles=st.integers(1, 25))
    def go(self, cycles: int) -> None:
        for _ in range(cycles):
            self.run.go(1)
            self.allowed = self.run.cell.supervisor.latch.first_cause is None and self.run.cell.task.state != "tripped"

    @rule(stale=st.booleans())
    def fault(self, stale: bool) -> None:
        self.run.fault(stale=stale)

    @rule(asks=st.lists(st.sampled_from(OperatorRequest), min_size=1, max_size=3))
    def press(self, asks: list[OperatorRequest]) -> None:
        latch = self.run.cell.supervisor.latch
        before, present = latch.first_cause, latch.state in (LatchState.TRIPPED, LatchState.FAULTED)
        waits = self.run.cell.task.state == "tripped"
        for ask in asks:
            self.run.channel.ask(ask, "ada")
        resets = len(self.run.loop.result.resets)
        self.run.go(1)
        cleared = len(self.run.loop.result.resets) - resets
        assert cleared <= 1
        if cleared:
            assert waits
            assert before is not None
            assert not present or not self.run.arm.faults.stale
        restarted = waits and self.run.cell.task.state != "tripped"
        if restarted:
            # Only a reset clears, and only what came after it goes on.
            assert before is None or (
                cleared and asks.index(OperatorRequest.RESET) < len(asks) - 1 - asks[::-1].index(OperatorRequest.RESUME)
            )
        self.allowed = latch.first_cause is None and self.run.cell.task.state != "tripped"

    @invariant()
    def latched_runs_do_not_work(self) -> None:
        if hasattr(self, "run") and self.run.cell.supervisor.latch.first_cause is not None:
            assert self.run.cell.task.finished

    def teardown(self) -> None:
        if hasattr(self, "run"):
            self.run.end()
        self.folder.cleanup()


TestImpatient = Impatient.TestCase
TestImpatient.settings = settings(max_examples=8, stateful_step_count=15)


def two_arms(folder: Path, **pair: Any) -> OperatedRun:
    """The arm of the task, and another that carries its sensor and holds something for it."""
    cell = waiting_cell(on_trip="end")
    cell["arms"]["arm"]["stop_category"] = 1
    cell["arms"]["other"] = {**cell["arms"]["arm"]}
    cell["sensors"]["sensor"]["mounted_on"] = "other"
    cell["interlocks"] = {name: entry for name, entry in cell["interlocks"].items() if name not in ("contact_lost",)}
    for name in ("workspace", "tilt"):
        cell["interlocks"][name] = {key: each for key, each in cell["interlocks"][name].items() if key != "sensor"}
    cell["pairs"] = [{"leader": "arm", "follower": "other", **pair}]
    return OperatedRun(folder, cell)


@pytest.mark.parametrize(
    ("pair", "faulty", "categories"),
    [
        ({}, "arm", {"arm": 1, "other": 2}),
        ({}, "other", {"arm": 1, "other": 1}),
        ({"on_stop": "same"}, "arm", {"arm": 1, "other": 1}),
    ],
)
def test_a_fault_of_the_leader_leaves_the_follower_its_power(
    tmp_path: Path, pair: dict[str, str], faulty: str, categories: dict[str, int]
) -> None:
    run = two_arms(tmp_path, **pair)
    run.go(20)
    arm = run.cell.arms[faulty]
    arm.faults = replace(arm.faults, nan_state=True)
    run.go(3)
    result = run.end()
    assert [(cause.interlock, cause.subject) for cause in result.causes[:1]] == [("finite", faulty)]
    assert {role: int(report.category) for role, report in result.stops.items()} == categories


def test_an_orderly_end_leaves_both_their_power(tmp_path: Path) -> None:
    run = two_arms(tmp_path)
    run.go(20)
    run.stop.ask_at_once()
    run.go(1)
    assert {int(report.category) for report in run.end().stops.values()} == {2}


@pytest.mark.parametrize("pair", [{"leader": "arm", "follower": "nobody"}, {"leader": "arm", "follower": "arm"}])
def test_a_pair_of_what_is_not_there_is_refused(tmp_path: Path, pair: dict[str, str]) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(waiting_cell(pairs=[pair])))
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path)
    assert caught.value.problems[0].key.startswith("pairs.0")


def test_reset_without_a_run_that_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["reset"]) == EXIT_BAD_INPUT
    assert "no run waits for a reset" in capsys.readouterr().err


def test_reset_and_resume_from_another_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = waiting_cell()
    # It trips by itself: gliding shears the contact, and the shear stays when the arm has stopped.
    cell["interlocks"]["shear"] = {"kind": "shear", "limit_mm": 2.0, "hold_ms": 20}
    path, folder = tmp_path / "cell.yaml", tmp_path / "run"
    path.write_text(yaml.safe_dump(cell))
    command = [sys.executable, "-m", "touchcell", "run", str(path), "--out", str(folder), "--quiet"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + DEADLINE_S
    while not is_waiting(folder):
        assert time.monotonic() < deadline_s
        assert process.poll() is None
        time.sleep(0.02)
    assert main(["resume", str(folder)]) == EXIT_TASK_FAILED
    assert "refused: reset first" in capsys.readouterr().out
    assert main(["reset", str(folder)]) == EXIT_TASK_FAILED
    assert "refused: a cause is still present" in capsys.readouterr().out
    # Black box and reason are there while it waits.
    assert json.loads((folder / "blackbox.json").read_text())["causes"][0]["interlock"] == "shear"
    assert main(["stop", str(folder)]) == EXIT_OK
    told, _ = process.communicate(timeout=DEADLINE_S)
    assert "tripped: shear" in told
    assert process.returncode == 3
    assert not is_waiting(folder)
