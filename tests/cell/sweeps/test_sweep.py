"""``touchcell sweep``: from options or a file to tables, plots and worst cases."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from touchcell.cell.cli.main import main
from touchcell.cell.sweeps.factors import make_factors
from touchcell.cell.sweeps.section import read_section
from touchcell.cell.sweeps.sweep import Sweep, run_sweep
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

SHORT = [
    "--set=sensors.sensor.estimator={kind: true_contact}",
    "--set=task.distance_mm=3",
    "--set=task.retract_mm=2",
    "--set=task.settle_time_s=0.05",
]


def sweep(*options: str, cell: str | Path = "surface_follow_sim.yaml", jobs: int = 1) -> int:
    return main(["sweep", str(cell), *SHORT, f"--jobs={jobs}", *options])


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_sweep_leaves_a_table_plots_and_the_worst_cases(tmp_path, capsys):
    pyarrow = pytest.importorskip("pyarrow.parquet")
    options = ["--grid", "task.depth_mm=2,3", "--sample", "seed=1..2", "--measure", "*.control.rms.z_mm"]
    assert sweep(*options, "--out", str(tmp_path), jobs=2) == 0
    printed = capsys.readouterr().out
    rows = rows_of(tmp_path)
    assert [(row["task.depth_mm"], row["seed"], row["outcome"]) for row in rows] == [
        ("2", "1", "done"),
        ("2", "2", "done"),
        ("3", "1", "done"),
        ("3", "2", "done"),
    ]
    worst = max(rows, key=lambda row: abs(float(row["sensor.control.rms.z_mm"])))
    command = f"touchcell run {tmp_path}/trials/{worst['trial']}/cell.yaml"
    assert command in printed
    assert "depth_mm 2" in printed
    assert (tmp_path / "sensor.control.rms.z_mm.png").is_file()
    table = pyarrow.read_table(tmp_path / "sweep.parquet").to_pylist()
    assert [row["sensor.control.rms.z_mm"] for row in table] == [
        pytest.approx(float(row["sensor.control.rms.z_mm"])) for row in rows
    ]
    assert json.loads((tmp_path / "summary.json").read_text())["outcomes"] == {"done": 4}
    assert main(["check", str(tmp_path / "trials" / worst["trial"] / "cell.yaml")]) == 0


def test_a_sweep_may_stand_in_a_cell_file_that_extends_another(tmp_path, capsys):
    cell = tmp_path / "mine.yaml"
    base = CONFIGS / "surface_follow_sim.yaml"
    cell.write_text(f"extends: {base}\nsweep:\n  grid: {{task.speed_mm_s: [20, 30]}}\n  measures: [duration_s]\n")
    assert main(["check", str(cell)]) == 0
    capsys.readouterr()
    assert sweep("--out", str(tmp_path / "out"), cell=cell) == 0
    durations = [float(row["duration_s"]) for row in rows_of(tmp_path / "out")]
    assert durations[1] < durations[0]


def test_a_trial_that_cannot_run_is_named_and_the_others_finish(tmp_path, capsys):
    assert sweep("--grid", "task.depth_mm=2,-1", "--out", str(tmp_path)) == 1
    assert [row["outcome"] for row in rows_of(tmp_path)] == ["done", "invalid"]
    assert "1: invalid:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("sweep: 3", "sweep"),
        ("sweep: {gird: {seed: 1..3}}", "sweep.gird"),
        ("sweep: {samples: 0}", "sweep.samples"),
    ],
)
def test_an_invalid_section_is_named_with_file_and_key(text, key, tmp_path):
    cell = tmp_path / "mine.yaml"
    cell.write_text(f"extends: {CONFIGS / 'surface_follow_sim.yaml'}\n{text}\n")
    with pytest.raises(ConfigError) as caught:
        read_section(cell)
    assert caught.value.key == key
    assert str(cell) in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        ["--grid", "task.depth_mm"],
        ["--grid", "=3"],
        ["--sample", "seed=gauss(1, 2)"],
        ["--search", "duration_s"],
        ["--grid", "tusk.depth_mm=1,2"],
        ["--executor", "locl"],
    ],
)
def test_a_mistake_on_the_command_line_is_one_message(options, tmp_path, capsys):
    code = sweep(*options, "--out", str(tmp_path))
    assert code in (1, 2)
    assert "Traceback" not in "".join(capsys.readouterr())


def test_a_measure_that_no_trial_has_is_refused_with_a_suggestion(tmp_path):
    factors = make_factors({"seed": "1,2"}, {}, None)
    settings = {"sensors.sensor.estimator": {"kind": "true_contact"}, "task.distance_mm": 3}
    with pytest.raises(ConfigError, match="duration_s"):
        run_sweep(Sweep(CONFIGS / "surface_follow_sim.yaml", factors, ("duration",), settings=settings), tmp_path)


def test_a_search_finds_the_fastest_run_that_ends_as_done(tmp_path, capsys):
    pytest.importorskip("optuna")
    options = ["--sample", "task.speed_mm_s=uniform(15, 40)", "--search", "duration_s", "--trials", "4"]
    assert sweep(*options, "--out", str(tmp_path)) == 0
    printed = capsys.readouterr().out
    assert "smallest duration_s of 4 trials" in printed
    assert "--set task.speed_mm_s=" in printed
    before = [path.stat().st_mtime_ns for path in sorted(tmp_path.glob("trials/*/run.mcap"))]
    assert sweep(*options, "--out", str(tmp_path)) == 0
    assert [path.stat().st_mtime_ns for path in sorted(tmp_path.glob("trials/*/run.mcap"))] == before
    assert capsys.readouterr().out == printed
