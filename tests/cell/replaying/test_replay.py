"""A replay of a run answers as the run did, and shows where changed limits and gains would not have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from touchcell.cell.cli.main import main
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.replaying.differences import Difference, Tolerance, differences
from touchcell.cell.replaying.recorded_run import read_run
from touchcell.cell.replaying.replay import replay

EXACT = Tolerance(contact=1e-6, twist=1e-6)
SHORT = ("--set", "task.distance_mm=10", "--quiet")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Run a shipped cell with settings, once for each of them, and return its folder."""
    folders: dict[tuple[str, ...], Path] = {}

    def run(cell: str, *settings: str, exit_code: int = 0) -> Path:
        if (cell, *settings) not in folders:
            folder = tmp_path_factory.mktemp("run") / "run"
            assert main(["run", cell, *settings, "--out", str(folder)]) == exit_code
            folders[cell, *settings] = folder
        return folders[cell, *settings]

    return run


@pytest.fixture
def with_images(recorded: Callable[..., Path]) -> Path:
    return recorded("surface_follow_sim.yaml", *SHORT, "--set", "recording.frames=png")


def out(tmp_path: Path) -> Path:
    folder = tmp_path / "replay"
    folder.mkdir()
    return folder


def by_name(found: list[Difference]) -> dict[str, Difference]:
    return {each.what: each for each in found}


def test_lossless_images_and_poses_give_the_run_again(with_images: Path, tmp_path: Path) -> None:
    done = replay(with_images, out(tmp_path))
    found = differences(done, EXACT)
    assert [each.what for each in found if not each.agrees] == []
    assert done.notes == ()
    contact = by_name(found)["contact of sensor"]
    assert len(contact.linear) > 100
    # The images were decoded and went through the network: the numbers are close, and not those of the recording.
    assert contact.linear.max() > 0.0


def test_a_run_without_images_is_replayed_from_its_estimates(recorded: Callable[..., Path], tmp_path: Path) -> None:
    done = replay(recorded("surface_follow_sim.yaml", *SHORT), out(tmp_path))
    assert all(each.agrees for each in differences(done, EXACT))
    assert "no images" in done.notes[0]


def test_estimates_that_no_filter_carries_on_are_counted_once_each(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    edge = ("--set", "task.close_loop=false", *SHORT)
    done = replay(recorded("edge_follow_sim.yaml", *edge), out(tmp_path))
    assert [str(each) for each in differences(done, EXACT) if not each.agrees] == []


def test_a_trip_is_found_again_in_the_same_cycle(recorded: Callable[..., Path], tmp_path: Path) -> None:
    folder = recorded("surface_follow_sim.yaml", *SHORT, "--set", "interlocks.indentation.limit_mm=3.1", exit_code=3)
    done = replay(folder, out(tmp_path))
    assert all(each.agrees for each in differences(done, EXACT))
    assert done.result.outcome.value == "tripped"
    assert len(done.recorded.cycles) == len(done.replayed.cycles)


def test_a_lower_limit_trips_on_what_was_recorded(with_images: Path, tmp_path: Path) -> None:
    done = replay(with_images, out(tmp_path), settings={"interlocks.indentation.limit_mm": 3.1})
    found = by_name(differences(done, EXACT))
    assert "now trip indentation: sensor" in found["violations"].others[0]
    assert found["end"].others[0].startswith(f"after {len(done.replayed.cycles)} of {len(done.recorded.cycles)} cycles")
    assert found["contact of sensor"].agrees


def test_another_speed_changes_twists_and_no_estimate(with_images: Path, tmp_path: Path) -> None:
    done = replay(with_images, out(tmp_path), settings={"task.speed_mm_s": 26})
    found = by_name(differences(done, EXACT))
    assert found["contact of sensor"].agrees
    apart = found["twist of arm"].linear
    # While the speed changes, and where it turns with the surface, cycles differ by more or less.
    assert np.median(apart[apart > 1.0]) == pytest.approx(6.0, abs=0.3)
    assert apart.max() < 7.0
    assert len(found["twist of arm"].beyond)


def test_only_what_came_before_a_reset_is_replayed(tmp_path: Path) -> None:
    file = tmp_path / RECORDING
    with Recorder(file) as recorder:
        recorder.write("/task", 1, {"state": "run"})
        recorder.write("/safety", 2, {"allow": False, "speed": 0.0, "violations": ["trip depth: sensor: 7 mm"]})
        recorder.write("/task", 2, {"state": "tripped"})
        recorder.write("/events", 3, {"event": "waiting", "reason": "for a reset"})
        recorder.write("/task", 9, {"state": "prepare"})
    found = read_run(file)
    assert found.resumed
    assert [cycle.task_state for cycle in found.cycles] == ["run", "tripped"]


@pytest.mark.parametrize(
    ("topic", "form", "lossy"), [("image", "png", False), ("image", "jpeg", True), ("video", "h264", True)]
)
def test_images_that_the_recording_has_changed_are_known(topic: str, form: str, lossy: bool, tmp_path: Path) -> None:
    file = tmp_path / RECORDING
    with Recorder(file) as recorder:
        recorder.write(f"/sensors/sensor/{topic}", 1, {"format": form})
        recorder.write("/task", 2, {"state": "run"})
    assert read_run(file).lossy is lossy


def test_the_command_says_what_differs_and_draws_it(
    with_images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    same, other = tmp_path / "same", tmp_path / "other"
    assert main(["replay", str(with_images), "--out", str(same)]) == 0
    assert "violations: the same" in capsys.readouterr().out
    assert (same / "replay.png").stat().st_size > 10_000
    assert main(["report", str(same)]) == 0
    assert main(["replay", str(with_images), "--set", "task.speed_mm_s=30", "--out", str(other)]) == 1
    assert "beyond 5" in capsys.readouterr().out


def test_a_recording_without_a_cycle_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        read_run(tmp_path / RECORDING)
    assert main(["replay", str(tmp_path / "nowhere"), "--out", str(tmp_path / "replay")]) == 2
    assert "Traceback" not in capsys.readouterr().err
