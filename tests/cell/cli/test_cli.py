"""The command line lists what there is, and says what is wrong in words and exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.cell.config.find import find_cell


def test_list_names_everything_a_cell_file_may_say(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == EXIT_OK
    printed = capsys.readouterr().out
    for word in ("sim_arm", "sim_tactip", "replay_camera", "surface_following", "object_tracking", "frame_age", "se3"):
        assert f"\n  {word} " in printed
    assert "configs/surface_follow_sim.yaml" in printed
    assert "cannot be loaded" not in printed


def test_check_tells_what_the_cell_is_made_of(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "configs/surface_follow_sim.yaml"]) == EXIT_OK
    printed = capsys.readouterr().out
    assert "is valid" in printed
    assert "surface_following" in printed


def test_a_cell_that_ships_is_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_cell(Path("configs/surface_follow_sim.yaml")).is_file()
    assert find_cell(Path("mine.yaml")) == Path("mine.yaml")


def test_unknown_benchmark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "se2", "--out", str(tmp_path)]) == EXIT_BAD_INPUT
    assert "did you mean 'se3'?" in capsys.readouterr().err


def test_replay_without_a_model_says_how_to_make_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "configs/replay_real.yaml", "--data", str(tmp_path), "--out", str(tmp_path / "run"), "--quiet"]
    assert main([*arguments, "--model", str(tmp_path / "none.safetensors")]) == EXIT_BAD_INPUT
    message = capsys.readouterr().err
    assert "none.safetensors" in message
    assert "touchcell train" in message


def test_evaluate_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "model.safetensors"
    model.write_bytes(b"short")
    assert main(["evaluate", "--data", str(tmp_path), "--model", str(model)]) == EXIT_BAD_INPUT
    assert str(tmp_path) in capsys.readouterr().err


def test_a_model_that_ships_is_named_on_the_command_line_as_in_a_cell_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["adapt", "--model", "builtin:sim_franka_tactip_1", "--data", str(tmp_path), "--out", str(tmp_path / "m")]
    assert main(words) == EXIT_BAD_INPUT
    assert "sim_franka_tactip_1.safetensors: camera: was adapted already" in capsys.readouterr().err
