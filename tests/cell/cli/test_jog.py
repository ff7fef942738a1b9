"""``touchcell jog`` on a simulated cell, from a terminal."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import yaml

from tests.helpers.jog_terminal import JogTerminal
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT
from touchcell.cell.cli.main import main
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.paths import CONFIGS


def cell(folder: Path) -> Path:
    data = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    put_on_true_contact(data)
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_without_a_terminal_it_says_so_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with open(os.devnull) as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        assert main(["jog", str(cell(tmp_path)), "--out", str(tmp_path / "run")]) == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert "terminal" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_move_save_and_end(tmp_path: Path) -> None:
    path, out = cell(tmp_path), tmp_path / "run"
    with JogTerminal("jog", str(path), "--out", str(out), "--speed", "20") as terminal:
        terminal.hold(b"", terminal.shows("idle"))
        terminal.hold(b"u", terminal.shows("moving"))
        terminal.hold(b"", terminal.shows("idle"))
        terminal.press(b"sstart\r")
        terminal.hold(b"", terminal.shows("saved arms.arm.start_pose_mm_deg"))
        terminal.press(b"q")
        assert terminal.process.wait(30) == 0
    start = yaml.safe_load(path.read_text())["arms"]["arm"]["start_pose_mm_deg"]
    assert start[0] > -80.0
    assert start[1:] == [0, 25, 180, 0, 0]
    assert json.loads((out / "result.json").read_text())["outcome"] == "done"
    # It is recorded as any run, and can be read again.
    run = RunFolder(out)
    assert run.plan.task.name == "jog"


def test_a_closed_terminal_ends_it_at_rest(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with JogTerminal("jog", str(cell(tmp_path)), "--out", str(out)) as terminal:
        terminal.hold(b"", terminal.shows("idle"))
        terminal.hold(b"u", terminal.shows("moving"))
        terminal.close_terminal()
        terminal.process.wait(30)
    result = json.loads((out / "result.json").read_text())
    assert result["outcome"] in ("done", "stopped")
    stop = result["stops"]["arm"]
    assert stop["time_s"] <= stop["declared_s"] + 0.01
