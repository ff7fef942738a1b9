"""Cells of the Python API: loaded with settings, run, and read back as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import touchcell as tc
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.settings import with_settings
from touchcell.cell.config.yaml_file import load
from touchcell.units import unit_of


@pytest.fixture(scope="module")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> tc.CellRun:
    folder = tmp_path_factory.mktemp("run") / "short"
    return tc.run(tc.load_cell("surface_follow_sim", set={"task.distance_mm": 10}), out=folder)


def test_a_cell_is_found_by_path_and_by_name(tmp_path: Path) -> None:
    copy = tmp_path / "mine.yaml"
    copy.write_text(tc.load_cell("surface_follow_sim").text())
    assert tc.load_cell(str(copy)).cell == tc.load_cell(copy).cell == tc.load_cell("surface_follow_sim").cell
    assert plan_cell(str(copy)).cell.name == "surface_follow_sim"


def test_a_setting_is_checked_like_the_file() -> None:
    assert tc.load_cell("surface_follow_sim", set={"task.speed_mm_s": 10}).task_config.speed_mm_s == 10  # type: ignore[attr-defined]
    with pytest.raises(tc.ConfigError, match=r"task\.sped_mm_s: unknown key \(did you mean 'speed_mm_s'\?\)"):
        tc.load_cell("surface_follow_sim", set={"task.sped_mm_s": 10})
    with pytest.raises(tc.ConfigError, match="is no section"):
        tc.load_cell("surface_follow_sim", set={"task.speed_mm_s.value": 10})
    with pytest.raises(tc.ConfigError, match="cannot be read"):
        tc.load_cell("no_such_cell")


def test_settings_leave_what_an_alias_shares_alone() -> None:
    shared = {"depth": 1}
    data = {"a": shared, "b": shared, "list": [1, {"c": 2}]}
    changed = with_settings(data, {"a.depth": 5, "list.1.c": 3, "new.key": 1})
    assert changed == {"a": {"depth": 5}, "b": {"depth": 1}, "list": [1, {"c": 3}], "new": {"key": 1}}
    assert data == {"a": {"depth": 1}, "b": {"depth": 1}, "list": [1, {"c": 2}]}
    with pytest.raises(tc.ConfigError, match="is no index of a list of 2"):
        with_settings(data, {"list.2": 1})


def test_a_run_says_how_it_ended_and_where_it_is(short_run: tc.CellRun) -> None:
    assert short_run.done
    assert repr(short_run).startswith("<CellRun 'surface_follow_sim': done after ")
    assert str(short_run.folder) in repr(short_run)
    assert (short_run.folder / "summary.txt").read_text().strip() == short_run.summary.strip()


def test_the_run_folder_holds_the_cell_as_it_was_run(short_run: tc.CellRun) -> None:
    assert load(short_run.folder / "cell.yaml").data["task"]["distance_mm"] == 10
    again = tc.load_cell(short_run.folder / "cell.yaml")
    assert again.task_config.distance_mm == 10  # type: ignore[attr-defined]


def test_a_recording_is_read_into_arrays_with_units(short_run: tc.CellRun) -> None:
    recording = tc.read_run(str(short_run.folder))
    assert recording.result["outcome"] == "done"
    tcp = recording["/arms/arm/tcp"]
    assert tcp["x_mm"].shape == tcp.t_s.shape
    assert tcp["x_mm"].dtype == np.float64
    assert tcp.units["x_mm"] == "mm"
    assert np.ptp(tcp["x_mm"]) == pytest.approx(10.0, abs=2.0)
    twist = recording["/arms/arm/command"]["twist"]
    assert twist.shape == (len(recording["/arms/arm/command"].t_s), 6)
    assert set(recording["/task"]["state"]) >= {"approach", "run"}
    assert recording["/sensors/sensor/truth"]["in_contact"].dtype == bool
    assert recording.events[-1]["event"] == "end"
    assert repr(recording).endswith(f"{len(recording)} topics, {tcp.t_s[-1]:.2f} s>")
    assert "z_mm [mm]" in repr(tcp)


def test_a_missing_topic_or_column_is_named_with_a_suggestion(short_run: tc.CellRun) -> None:
    recording = tc.read_run(short_run.folder)
    with pytest.raises(KeyError, match="did you mean '/arms/arm/tcp'"):
        recording["/arms/arm/tpc"]
    with pytest.raises(KeyError, match="did you mean 'z_mm'"):
        recording["/arms/arm/tcp"]["z_m"]


def test_a_folder_without_a_recording_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(tc.TouchcellError, match="cannot be read"):
        tc.read_run(tmp_path)


@pytest.mark.parametrize(
    ("column", "unit"),
    [("z_mm", "mm"), ("speed_mm_s", "mm/s"), ("ttl_s", "s"), ("cycle_us", "us"), ("state", ""), ("force_n", "N")],
)
def test_the_unit_is_read_from_the_name(column: str, unit: str) -> None:
    assert unit_of(column) == unit


def test_a_composed_cell_prints_its_task_and_devices() -> None:
    cell = tc.compose(tc.load_cell("surface_follow_sim"))
    printed = "<Cell 'surface_follow_sim': task surface_following in 'prepare', <SimArm 'arm': disconnected>"
    assert repr(cell).startswith(printed)
