"""A run folder belongs to one run: nothing in it is overwritten, and nothing of another run is taken for this one's."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT
from touchcell.cell.cli.main import main
from touchcell.cell.runtime.operator_input import FolderInUse
from touchcell.cell.runtime.run_directory import RunFolderError, run_directory
from touchcell.paths import CONFIGS

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


def test_runs_that_begin_in_one_second_get_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda _: "20261128-120000")
    made = []
    for _ in range(3):
        with run_directory("cell", runs=tmp_path / "runs") as folder:
            made.append(folder.name)
    assert made == ["cell-20261128-120000", "cell-20261128-120000-2", "cell-20261128-120000-3"]


@pytest.mark.parametrize("left", ["run.mcap", "blackbox.json", "anything"])
def test_a_folder_that_holds_something_is_refused_and_left_as_it_is(tmp_path: Path, left: str) -> None:
    (tmp_path / left).write_text("evidence")
    with pytest.raises(RunFolderError, match="holds something already"), run_directory("cell", tmp_path):
        pytest.fail("entered")
    assert [path.name for path in tmp_path.iterdir()] == [left]
    assert (tmp_path / left).read_text() == "evidence"


def test_a_run_in_the_folder_of_one_that_goes_on_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with run_directory("cell", out):
        (before,) = out.iterdir()
        content = before.read_text()
        with pytest.raises(FolderInUse), run_directory("cell", out):
            pytest.fail("entered")
        assert list(out.iterdir()) == [before]
        assert before.read_text() == content


def test_an_empty_folder_may_be_used(tmp_path: Path) -> None:
    with run_directory("cell", tmp_path) as folder:
        assert folder == tmp_path


@pytest.mark.parametrize("name", ["../evil", "../../evil", "a/b"])
def test_no_folder_is_made_outside_runs(tmp_path: Path, name: str) -> None:
    with pytest.raises(RunFolderError), run_directory(name, runs=tmp_path / "runs"):
        pytest.fail("entered")
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_way_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "run", Path("/proc/run")):
        assert main(["run", str(SHIPPED), "--out", str(out), "--quiet"]) == EXIT_BAD_INPUT
        told = capsys.readouterr().err
        assert len(told.splitlines()) == 1
        assert str(out) in told
        assert "--out" in told


def test_a_second_run_does_not_touch_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main(["run", str(SHIPPED), "--out", str(out), "--quiet"]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    capsys.readouterr()
    assert main(["run", str(SHIPPED), "--out", str(out), "--quiet"]) == EXIT_BAD_INPUT
    assert "holds something already" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
