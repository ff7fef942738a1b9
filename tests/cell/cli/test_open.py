"""``touchcell open`` and ``report --html``: a run in other programs."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from touchcell.cell.cli.main import main
from touchcell.cell.recording.mcap import RECORDING, read, wall_clock_offset_ns
from touchcell.cell.recording.salvage import whole


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("run") / "run"
    words = ["--set", "task.distance_mm=5", "--quiet", "--out", str(target)]
    assert main(["run", "configs/surface_follow_sim.yaml", *words]) == 0
    return target


def test_a_foxglove_layout_shows_the_cells_own_topics(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["open", str(folder)]) == 0
    layout = (folder / "foxglove_layout.json").read_text()
    json.loads(layout)
    for wanted in (
        "/scene",
        "/log",
        "/task.state",
        "/sensors/sensor/contact.z_mm",
        "/arms/arm/tcp.speed_mm_s",
        "ThreeDee",
    ):
        assert wanted in layout
    assert str(folder) in capsys.readouterr().out


def test_a_run_is_written_for_rerun_with_what_rerun_does_not_draw_itself(folder: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("rerun-sdk is not installed (pip install 'touchcell[rerun]')")
    target = tmp_path / "run.rrd"
    assert main(["open", str(folder), "--rerun", "--to", str(target)]) == 0
    assert target.stat().st_size > 10_000


@pytest.mark.parametrize("kept", [0.05, 0.5, 0.999])
def test_a_run_that_was_cut_off_is_written_for_rerun_up_to_the_cut(folder: Path, tmp_path: Path, kept: float) -> None:
    pytest.importorskip("rerun", reason="pip install 'touchcell[rerun]'")
    cut = tmp_path / "cut"
    shutil.copytree(folder, cut)
    content = (cut / RECORDING).read_bytes()
    (cut / RECORDING).write_bytes(content[: int(kept * len(content))])
    with whole(cut / RECORDING) as readable:
        assert list(read(readable)) == list(read(cut / RECORDING))
        with readable.open("rb") as stream:
            assert make_reader(stream).get_summary() is not None
    assert main(["open", str(cut), "--rerun", "--to", str(tmp_path / "run.rrd")]) == 0
    assert (tmp_path / "run.rrd").stat().st_size > 10_000


def test_a_run_that_is_whole_is_not_written_anew(folder: Path) -> None:
    with whole(folder / RECORDING) as readable:
        assert readable == folder / RECORDING
    assert wall_clock_offset_ns(folder / RECORDING) > 1e18


def test_reruns_viewer_need_not_be_in_path_and_its_failure_is_one_message(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rerun = pytest.importorskip("rerun", reason="pip install 'touchcell[rerun]'")
    asked: list[str] = []

    def spawn(*, executable_path: str, **_: object) -> None:
        asked.append(executable_path)
        raise RuntimeError("no display\nand much more")

    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun, "spawn", spawn)
    assert main(["open", str(folder), "--rerun"]) == 2
    assert Path(asked[0]).is_file()
    printed = capsys.readouterr().err
    assert "does not start: no display" in printed
    assert "much more" not in printed
    assert "--foxglove" in printed


@pytest.mark.skipif(sys.platform != "linux", reason="only there a machine without a display says so")
def test_without_a_display_it_says_so_and_how_to_see_it_in_a_browser(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun", reason="pip install 'touchcell[rerun]'")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["open", str(folder), "--rerun"]) == 2
    printed = capsys.readouterr().err
    assert "no display" in printed
    assert "--to FILE.rrd" in printed


def test_a_target_without_rerun_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["open", str(folder), "--to", "x.rrd"]) == 2
    assert "--rerun" in capsys.readouterr().err


def test_the_html_report_is_one_file_that_loads_nothing(folder: Path) -> None:
    pytest.importorskip("plotly", reason="pip install 'touchcell[html]'")
    assert main(["report", str(folder), "--html"]) == 0
    page = (folder / "report.html").read_text()
    assert "surface_following done" in page
    assert "Contact of sensor" in page
    assert 'src="http' not in page


def test_latest_and_a_folder_contradict_each_other(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(folder), "--latest"]) == 2
    assert "--latest" in capsys.readouterr().err


def test_latest_is_the_newest_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "last").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    assert main(["report", "--latest"]) == 0
    assert "surface_following done" in capsys.readouterr().out
