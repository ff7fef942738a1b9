"""A composed cell runs to its end, and stops safely when an operator, an interlock, the disk or a device says so."""

from __future__ import annotations

import errno
import io
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.helpers.unforeseen import run_into_the_wall
from touchcell.cell.cli.main import main
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.recording.mcap import read
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, Progress, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.paths import CONFIGS
from touchcell.simulation.devices.arm import SimArm

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


def true_contact_cell(tmp_path: Path, change: Callable[[dict[str, Any]], None] | None = None) -> Path:
    """The shipped cell on the simulator's own contacts, with a short way to go."""
    data = yaml.safe_load(SHIPPED.read_text())
    put_on_true_contact(data)
    data["task"]["distance_mm"] = 20
    if change is not None:
        change(data)
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def run(
    path: Path,
    *,
    recorder: Recorder | None = None,
    stop: StopRequest | None = None,
    on_cycle: Callable[[Cell, Progress], None] | None = None,
) -> tuple[Cell, RunResult]:
    cell = compose(plan_cell(path))
    hook = None if on_cycle is None else lambda progress: on_cycle(cell, progress)
    with cell:
        result = RunLoop(cell, recorder, stop=stop, on_cycle=hook).run()
        for arm in cell.arms.values():
            assert arm.at_rest()
            assert arm.owner is None
    return cell, result


def test_surface_following_reaches_its_end(tmp_path: Path) -> None:
    _, result = run(true_contact_cell(tmp_path))
    assert result.outcome is Outcome.DONE
    assert result.error is None
    assert 2.0 < result.duration_s < 6.0


def test_two_runs_are_identical(tmp_path: Path) -> None:
    path = true_contact_cell(tmp_path)
    recordings = []
    for name in ("a.mcap", "b.mcap"):
        with Recorder(tmp_path / name) as recorder:
            run(path, recorder=recorder)
        # How long a cycle takes is the machine's affair.
        recordings.append([(m.topic, m.t_ns, m.data) for m in read(tmp_path / name) if m.topic != "/timing"])
    assert recordings[0] == recordings[1]
    assert len(recordings[0]) > 1000


def test_run_command_leaves_a_folder_that_speaks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    assert main(["run", str(true_contact_cell(tmp_path)), "--out", str(folder), "--quiet"]) == 0
    names = {path.name for path in folder.iterdir()}
    assert names >= {"cell.yaml", "run.mcap", "result.json", "summary.json", "summary.txt"}
    assert names >= {"contact_sensor.png", "trajectory.png"}
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["outcome"] == "done"
    assert summary["errors"]["sensor"]["control"]["rms"]["z_mm"] < 0.2
    assert str(folder) in capsys.readouterr().out


def test_operator_stop_ends_in_retreat(tmp_path: Path) -> None:
    stop = StopRequest()

    def ask_while_running(cell: Cell, progress: Progress) -> None:
        if progress.state == "run" and stop.count == 0:
            stop.ask()

    cell, result = run(true_contact_cell(tmp_path), stop=stop, on_cycle=ask_while_running)
    assert result.outcome is Outcome.STOPPED
    assert [record.target for record in cell.task.transitions][-2:] == ["retract", "stopped"]


def test_second_stop_is_at_once(tmp_path: Path) -> None:
    stop = StopRequest()
    asked_at: list[float] = []

    def ask_twice(cell: Cell, progress: Progress) -> None:
        if progress.state == "run" and not asked_at:
            stop.ask()
            stop.ask()
            asked_at.append(progress.t_s)

    _, result = run(true_contact_cell(tmp_path), stop=stop, on_cycle=ask_twice)
    assert result.outcome is Outcome.STOPPED
    assert "at once" in result.reason
    assert result.duration_s - asked_at[0] < 0.3


def test_workspace_trip_latches_and_stops_the_arm(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        cell, result = run(true_contact_cell(tmp_path, run_into_the_wall), recorder=recorder)
    assert result.outcome is Outcome.TRIPPED
    assert result.reason.startswith("workspace")
    assert cell.task.state == "tripped"
    commands = [m.t_ns for m in read(tmp_path / "run.mcap") if m.topic == "/arms/arm/command"]
    trips = [m.t_ns for m in read(tmp_path / "run.mcap") if m.data.get("to") == "tripped"]
    assert max(commands) < min(trips)
    x_mm = [m.data["x_mm"] for m in read(tmp_path / "run.mcap") if m.topic == "/arms/arm/tcp"]
    # 20 mm/s at 0.5 m/s^2 stops within 0.4 mm; a cycle's way and the filter's margin come on top.
    assert max(x_mm) < -72 + 1.0


def test_a_limit_slows_the_arm_down_and_trips_when_it_lasts(tmp_path: Path) -> None:
    def touchy(data: dict[str, Any]) -> None:
        data["interlocks"]["shear"] = {"kind": "shear", "limit_mm": 2, "severity": "limit"}

    with Recorder(tmp_path / "run.mcap") as recorder:
        _, result = run(true_contact_cell(tmp_path, touchy), recorder=recorder)
    assert result.outcome is Outcome.TRIPPED
    assert "limiting for over 300 ms" in result.reason
    messages = list(read(tmp_path / "run.mcap"))
    limited_ns = [m.t_ns for m in messages if m.topic == "/safety"]
    assert result.causes[0].t_ns - limited_ns[0] == 310_000_000
    commands = [m for m in messages if m.topic == "/arms/arm/command"]
    before = [m.data["speed_mm_s"] for m in commands if m.t_ns < limited_ns[0]][-5:]
    after = [m.data["speed_mm_s"] for m in commands if m.t_ns > limited_ns[0] + 100_000_000]
    # A quarter of the 20 mm/s, and the servo's corrections.
    assert min(before) > 19
    assert len(after) == 20
    assert max(after) < 6
    assert result.stops["arm"].kept


class _FullDisk(io.BytesIO):
    def write(self, data: object) -> int:
        if self.tell() > 60_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)  # type: ignore[arg-type]


def test_full_disk_stops_the_run_safely_and_keeps_the_recording(tmp_path: Path) -> None:
    disk = _FullDisk()
    recorder = Recorder(tmp_path / "run.mcap", stream=disk)
    _, result = run(true_contact_cell(tmp_path), recorder=recorder)
    assert result.outcome is Outcome.ERROR
    assert "No space left" in result.reason
    kept = tmp_path / "kept.mcap"
    kept.write_bytes(disk.getvalue())
    assert sum(message.topic == "/arms/arm/tcp" for message in read(kept)) > 50


def test_arm_that_reports_nonsense_trips_before_anything_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent_after: list[float] = []
    honest = SimArm.tcp
    broken = {"from_ns": 10**18}

    def lying(arm: SimArm, max_age_s: float | None = None) -> Any:
        state = honest(arm, max_age_s)
        if state.t_ns >= broken["from_ns"]:
            state.value.T_base_tcp[0, 3] = np.nan
        return state

    monkeypatch.setattr(SimArm, "tcp", lying)
    stream = SimArm._stream_twist

    def watched(arm: SimArm, twist: Any, ttl_s: float, now_ns: int) -> None:
        if now_ns >= broken["from_ns"]:
            sent_after.append(now_ns)
        stream(arm, twist, ttl_s, now_ns)

    monkeypatch.setattr(SimArm, "_stream_twist", watched)

    def break_it(cell: Cell, progress: Progress) -> None:
        if progress.state == "run" and broken["from_ns"] == 10**18:
            broken["from_ns"] = cell.clock.now_ns() + 1

    cell = compose(plan_cell(true_contact_cell(tmp_path)))
    with cell:
        result = RunLoop(cell, None, on_cycle=lambda progress: break_it(cell, progress)).run()
    assert result.outcome in (Outcome.TRIPPED, Outcome.ERROR)
    assert sent_after == []


def test_max_duration_ends_the_run(tmp_path: Path) -> None:
    def hurry(data: dict[str, Any]) -> None:
        data["max_duration_s"] = 0.5

    _, result = run(true_contact_cell(tmp_path, hurry))
    assert result.outcome is Outcome.STOPPED
    assert "max_duration_s" in result.reason
    assert result.duration_s < 1.0


def test_a_device_that_cannot_be_connected_leaves_the_others_disconnected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from touchcell.simulation.devices.tactip import SimTactip

    def refuse(camera: SimTactip) -> None:
        raise ConnectError(camera.name, "no such camera")

    monkeypatch.setattr(SimTactip, "_open", refuse)
    cell = compose(plan_cell(true_contact_cell(tmp_path)))
    with pytest.raises(ConnectError), cell:
        pass
    arm = cell.arms["arm"]
    assert isinstance(arm, Arm)
    assert arm.state.value == "disconnected"


def test_trip_has_its_own_exit_code(tmp_path: Path) -> None:
    assert (
        main(["run", str(true_contact_cell(tmp_path, run_into_the_wall)), "--out", str(tmp_path / "r"), "--quiet"]) == 3
    )


def test_bad_cell_is_exit_code_two_and_one_line_on_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "none.yaml")]) == 2
    assert "No such file" in capsys.readouterr().err


def test_a_state_that_comes_while_the_cycle_senses_is_not_from_the_future(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in real time, where a driver's own thread takes in a sample after the cycle has begun."""
    cell = compose(plan_cell(true_contact_cell(tmp_path)))
    tell = SimArm.tcp

    def late(arm: SimArm, max_age_s: float | None = None) -> Stamped[TcpState]:
        cell.clock.sleep_until_ns(cell.clock.now_ns() + 50_000)
        return replace(tell(arm, max_age_s), t_ns=cell.clock.now_ns())

    monkeypatch.setattr(SimArm, "tcp", late)
    with cell:
        result = RunLoop(cell, None).run()
    assert result.outcome is Outcome.DONE, result.reason
