"""What the page shows of a run is what its recording says, at any moment of it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from touchcell.cell.cli.main import main
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.message_types import Encoder
from touchcell.cell.recording.messages import declared_type
from touchcell.cell.runtime.black_box import BlackBox
from touchcell.cell.runtime.operator_input import reachable
from touchcell.cell.ui.run_view import RunView, sources
from touchcell.cell.ui.runs import Runs
from touchcell.cell.ui.stl import stl
from touchcell.geometry.solids import Cuboid, triangulated

_DEADLINE_S = 30.0


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one run, whose images are recorded."""
    root = tmp_path_factory.mktemp("runs")
    changes = ("recording.frames=jpeg", "task.distance_mm=5", "task.retract_mm=5", "task.approach_speed_mm_s=20")
    settings = [word for each in changes for word in ("--set", each)]
    assert main(["run", "surface_follow_sim.yaml", "--quiet", "--out", str(root / "first"), *settings]) == 0
    return root


@pytest.fixture(scope="module")
def view(runs: Path) -> RunView:
    view = RunView(runs / "first")
    view.read()
    return view


def test_states_and_events_follow_time(view: RunView) -> None:
    end_s = view.end_s
    assert end_s is not None
    moments = [view.moment(t_s) for t_s in np.linspace(0.05, end_s, 40)]
    states = [moment.state for moment in moments if moment is not None]
    assert list(dict.fromkeys(states))[:2] == ["prepare", "approach"]
    assert states[-1] == "done"
    assert [len(moment.events) for moment in moments if moment] == sorted(len(m.events) for m in moments if m)


def test_every_interlock_has_a_bar_and_those_in_the_recording_a_fraction(view: RunView) -> None:
    moment = next(m for m in map(view.moment, np.linspace(0.0, view.end_s or 0.0, 60)) if m and m.state == "run")
    assert [bar.interlock for bar in moment.bars] == list(view.plan.cell.interlocks)
    fractions = {bar.interlock: bar.fraction for bar in moment.bars}
    assert fractions["indentation"] == pytest.approx(3.0 / 5.0, abs=0.1)
    assert 0.0 < (fractions["tilt"] or 0.0) < 0.3
    # Timers and what is compared with earlier images come from the supervisor.
    assert all(fraction is not None for fraction in fractions.values())
    assert fractions["limited"] == 0.0
    texts = {bar.interlock: bar.text for bar in moment.bars}
    assert texts["frozen_frame"].endswith("of 200 ms")
    assert texts["exposure"].endswith("%")


def test_a_contact_has_six_components_with_deviations(view: RunView) -> None:
    touching = [m.contacts[0] for m in map(view.moment, np.linspace(0.0, view.end_s or 0.0, 60)) if m and m.contacts]
    row = next(each for each in touching if each.values)
    assert [name for name, _, _ in row.values][:3] == ["x_mm", "y_mm", "z_mm"]
    assert all(sigma > 0.0 for _, _, sigma in row.values)


def test_tool_and_sensor_are_where_they_were(view: RunView) -> None:
    first, last = view.moment(0.05), view.moment()
    assert first is not None
    assert last is not None
    assert first.poses["arms/arm/tcp"][2, 3] == pytest.approx(0.025, abs=0.003)
    assert last.poses["arms/arm/tcp"][0, 3] > first.poses["arms/arm/tcp"][0, 3] + 0.004


def test_there_are_pictures_and_not_too_many(view: RunView) -> None:
    assert view.picture("sensor", 0.0) is None or view.picture("sensor", 0.0) != view.picture("sensor")
    assert (view.picture("sensor") or b"")[:2] == b"\xff\xd8"
    assert view.picture("other") is None


def test_a_run_in_progress_is_followed_to_its_end(runs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "live"
    folder.mkdir()
    (folder / "cell.yaml").write_bytes((runs / "first" / "cell.yaml").read_bytes())
    whole = (runs / "first" / RECORDING).read_bytes()
    half = len(whole) // 2
    (folder / RECORDING).write_bytes(whole[:half])
    view = RunView(folder)
    deadline_s = time.monotonic() + _DEADLINE_S
    with reachable(folder):
        view.start()
        while view.moment() is None:
            assert time.monotonic() < deadline_s, view.problem
        assert view.running
        assert view.end_s is None
        with (folder / RECORDING).open("ab") as stream:
            stream.write(whole[half:])
    while view.end_s is None:
        assert time.monotonic() < deadline_s, view.problem
    moment = view.moment()
    assert moment is not None
    assert moment.state == "done"
    view.close()


def test_a_damaged_recording_is_a_message(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_bytes((runs / "first" / "cell.yaml").read_bytes())
    (tmp_path / RECORDING).write_bytes(b"no recording at all")
    view = RunView(tmp_path)
    view.read()
    assert "not an MCAP file" in view.problem
    assert view.moment() is None


@pytest.mark.parametrize("name", ["..", "../first", ".", "nothing", "first/../first", "/etc"])
def test_only_runs_are_runs(runs: Path, name: str) -> None:
    assert Runs(runs, runs).folder(name) is None


def test_runs_are_listed_with_their_outcome(runs: Path) -> None:
    [listed] = Runs(runs, runs).listed()
    assert (listed.name, listed.outcome, listed.running) == ("first", "done", False)
    assert Runs(runs / "none", runs).listed() == []


def test_stl_has_every_triangle() -> None:
    mesh = triangulated(Cuboid((0.1, 0.2, 0.3)))
    data = stl(mesh)
    assert len(data) == 84 + 50 * len(mesh.triangles)
    assert int.from_bytes(data[80:84], "little") == 12


def test_a_black_box_is_shown_by_the_same_widgets(runs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "tripped"
    changes = ("task.distance_mm=40", "interlocks.shear.limit_mm=2")
    settings = [word for each in changes for word in ("--set", each)]
    assert main(["run", "surface_follow_sim.yaml", "--quiet", "--out", str(folder), *settings]) == 3
    assert sources(folder) == [RECORDING, "blackbox.mcap"]
    assert Runs(folder.parent, folder).view("tripped", "../tripped/run.mcap") is None
    whole, box = RunView(folder), RunView(folder, "blackbox.mcap")
    whole.read()
    box.read()
    first, last = whole.moment(), box.moment()
    assert first is not None
    assert last is not None
    assert last.state == first.state
    assert last.contacts == first.contacts
    np.testing.assert_allclose(last.poses["arms/arm/tcp"], first.poses["arms/arm/tcp"])
    assert [bar.text for bar in last.bars] == [bar.text for bar in first.bars]


def test_the_ring_of_a_run_that_was_killed_is_shown(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_bytes((runs / "first" / "cell.yaml").read_bytes())
    encoder = Encoder(declared_type)
    with BlackBox(tmp_path, {}) as box:
        for t_ns, state in ((0, "approach"), (10**9, "run")):
            box.add([("/task", t_ns, encoder.encode("/task", {"state": state}))])
    assert sources(tmp_path) == ["blackbox.ring"]
    view = RunView(tmp_path, "blackbox.ring")
    view.read()
    assert view.problem == ""
    early, late = view.moment(0.5), view.moment()
    assert early is not None
    assert late is not None
    assert (early.state, late.state) == ("approach", "run")
