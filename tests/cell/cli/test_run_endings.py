"""How ``touchcell run`` ends: its exit code, result.json and last words, whatever becomes of its output."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

import pytest
import yaml

import touchcell as tc
from tests.helpers.pushing_cell import cell_file
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_DEVICE_LOST, EXIT_OK, EXIT_TASK_FAILED, EXIT_TRIPPED
from touchcell.cell.cli.main import main
from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.simulation.devices.arm import SimArm


def cell(folder: Path, **changes: Any) -> Path:
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(cell_file("surface_follow_sim.yaml", task__distance_mm=2, **changes)))
    return path


def result_of(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return result


def test_done_is_0(tmp_path: Path) -> None:
    assert main(["run", str(cell(tmp_path)), "--quiet", "--out", str(tmp_path / "run")]) == EXIT_OK
    assert result_of(tmp_path / "run")["outcome"] == "done"
    assert not (tmp_path / "run" / "blackbox.json").exists()


def test_a_task_that_fails_is_1_and_its_reason_is_in_the_result_and_on_the_screen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = cell(tmp_path, task__approach_distance_mm=1), tmp_path / "run"
    assert main(["run", str(path), "--quiet", "--out", str(folder)]) == EXIT_TASK_FAILED
    reason = result_of(folder)["reason"]
    assert reason.startswith("no_contact: none within 1 mm")
    assert reason in capsys.readouterr().out
    assert main(["why", str(folder)]) == EXIT_OK
    assert reason in capsys.readouterr().out


def test_a_trip_is_3(tmp_path: Path) -> None:
    path, folder = (
        cell(tmp_path, interlocks__shear__limit_mm=0.25, interlocks__shear__hold_ms=0),
        tmp_path / "run",
    )
    assert main(["run", str(path), "--quiet", "--out", str(folder)]) == EXIT_TRIPPED
    assert result_of(folder)["reason"].startswith("shear: ")


def test_a_cell_that_is_wrong_is_2(tmp_path: Path) -> None:
    assert main(["run", str(cell(tmp_path, rate_hz=-1)), "--quiet", "--out", str(tmp_path / "run")]) == EXIT_BAD_INPUT


def test_a_device_that_is_not_there_is_4_and_has_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(arm: SimArm) -> None:
        raise ConnectError(arm.name, "nothing answers")

    monkeypatch.setattr(SimArm, "_open", nothing)
    assert main(["run", str(cell(tmp_path)), "--quiet", "--out", str(tmp_path / "run")]) == EXIT_DEVICE_LOST
    assert result_of(tmp_path / "run")["outcome"] == "error"
    assert "nothing answers" in result_of(tmp_path / "run")["reason"]


def test_a_device_that_is_lost_when_it_is_given_back_is_4_and_the_result_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(arm: SimArm, policy: Any) -> None:
        raise DeviceGone(arm.name, "unplugged")

    monkeypatch.setattr(SimArm, "_deactivate", gone)
    assert main(["run", str(cell(tmp_path)), "--quiet", "--out", str(tmp_path / "run")]) == EXIT_DEVICE_LOST
    assert result_of(tmp_path / "run")["outcome"] == "done"
    assert "unplugged" in result_of(tmp_path / "run")["after_the_run"]


def run_into(path: Path, folder: Path, stdout: int | IO[str], stderr: int | IO[str]) -> int:
    command = [sys.executable, "-m", "touchcell", "run", str(path), "--quiet", "--out", str(folder)]
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, check=False).returncode


@pytest.mark.parametrize(("output", "limit_mm"), [("closed pipe", 0.25), ("/dev/full", 6.0)])
def test_the_exit_code_is_the_same_whatever_becomes_of_the_output(tmp_path: Path, output: str, limit_mm: float) -> None:
    path, folder = (
        cell(tmp_path, interlocks__shear__limit_mm=limit_mm, interlocks__shear__hold_ms=0),
        tmp_path / "run",
    )
    if output == "/dev/full":
        with Path(output).open("w") as full:
            code = run_into(path, folder, full, full)
    else:
        reading, writing = os.pipe()
        os.close(reading)
        try:
            code = run_into(path, folder, writing, writing)
        finally:
            os.close(writing)
    assert code == (EXIT_TRIPPED if limit_mm == 0.25 else EXIT_OK)
    assert result_of(folder)["outcome"] == ("tripped" if limit_mm == 0.25 else "done")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    words = ["--set", "task.distance_mm=2", "--set", "task.retract_mm=3", "--quiet", "--out", str(folder)]
    assert main(["run", str(cell(folder.parent)), *words]) == 0
    return folder


@pytest.mark.parametrize("left", ["", "{", "[]", "null", '{"outcome": "done"}', "\x00"])
def test_a_result_that_is_missing_or_damaged_is_said_first_and_the_recording_is_reported(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], left: str
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "result.json").unlink()
    if left:
        (folder / "result.json").write_text(left)
    assert main(["report", str(folder)]) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert "surface_following has no result after" in first
    assert ("result.json is damaged" if left else "it was killed, crashed") in first
    assert any("closest:" in line for line in rest)
    assert main(["why", str(folder)]) == 0
    assert "arm: moved" in capsys.readouterr().out
    assert tc.read_run(folder)["/arms/arm/tcp"].t_s.size > 100


def test_a_recording_that_is_cut_off_says_so_before_its_numbers(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    content = (folder / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(content[: 2 * len(content) // 3])
    assert main(["report", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "done after" in lines[0]
    assert "recorded until" in lines[1]
    assert "damaged in 1 place, first at byte" in lines[1]


def test_a_black_box_without_its_description_leaves_the_answer_to_the_recording(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "blackbox.json").write_text('{"outcome": ')
    assert main(["why", str(folder)]) == 0
    assert "evidence: run.mcap" in capsys.readouterr().out


def test_a_recording_to_which_nothing_was_written_is_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.mcap").write_bytes(b"")
    assert main(["report", str(tmp_path)]) == 2
    assert "is empty: its writer ended before anything was written" in capsys.readouterr().err
