"""``--set`` and ``check --explain``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from touchcell.cell.cli.main import main

CELL = "surface_follow_sim.yaml"
SHORT = ["--set", "task.distance_mm=5", "--set", "sensors.sensor.estimator={kind: true_contact}"]


def test_a_run_obeys_settings_and_keeps_them_in_its_folder(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert main(["run", CELL, "--quiet", "--out", str(out), *SHORT]) == EXIT_OK
    kept = yaml.safe_load((out / "cell.yaml").read_text())
    assert kept["task"]["distance_mm"] == 5
    assert kept["sensors"]["sensor"]["estimator"] == {"kind": "true_contact"}
    assert json.loads((out / "result.json").read_text())["outcome"] == "done"
    assert main(["report", str(out)]) == EXIT_OK


@pytest.mark.parametrize("command", ["run", "check", "probe"])
@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("task.depth_mm=deep", "--set: task.depth_mm: must be a valid number"),
        ("task.dpth_mm=2", "--set: task.dpth_mm: unknown key (did you mean 'depth_mm'?)"),
        ("tsk.depth_mm=2", "--set: tsk: unknown key (did you mean 'task'?)"),
        ("task.depth_mm", "--set: is not KEY=VALUE"),
        ("name.first=2", "is no section"),
    ],
)
def test_a_wrong_setting_is_one_message(
    command: str, setting: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, CELL, "--set", setting]) == EXIT_BAD_INPUT
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.out == ""


def test_probe_obeys_settings(capsys: pytest.CaptureFixture[str]) -> None:
    pose = "arms.arm.start_pose_mm_deg=[-70, 0, 25, 180, 0, 0]"
    assert main(["probe", CELL, "--set", pose]) == EXIT_OK
    assert "[-70.0, 0.0, 25.0, 180.0, 0.0, 0.0]" in capsys.readouterr().out


def test_check_explains_where_each_value_comes_from(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", CELL, "--explain", "--set", "task.speed_mm_s=10"]) == EXIT_OK
    printed = capsys.readouterr().out
    assert yaml.safe_load(printed)["task"]["speed_mm_s"] == 10
    speed = next(row for row in printed.splitlines() if row.strip().startswith("speed_mm_s"))
    depth = next(row for row in printed.splitlines() if row.strip().startswith("depth_mm"))
    assert speed.endswith("# --set")
    assert f"{CELL}:" in depth


def test_check_explains_a_file_that_is_not_valid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", CELL, "--explain", "--set", "task.depth_mm=9"]) == EXIT_BAD_INPUT
    printed = capsys.readouterr()
    assert "depth_mm: 9" in printed.out
    assert "9 mm is not below the limit of interlocks.indentation" in printed.err
