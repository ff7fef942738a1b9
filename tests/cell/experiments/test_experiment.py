"""Experiments: trials that change cells, tables over them, and continuing after an interruption."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.cli.main import main
from touchcell.cell.experiments.executors import Workers
from touchcell.cell.experiments.run_trials import perform_all
from touchcell.cell.experiments.runner import EXPERIMENTS, ExperimentSpec, Scale, run_experiment
from touchcell.cell.experiments.table import Column, Row, table, to_json
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.cell.recording.mcap import read
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

SHORT = {
    "sensors.sensor.estimator": {"kind": "true_contact"},
    "task.distance_mm": 3,
    "task.retract_mm": 2,
    "task.settle_time_s": 0.05,
}


def trial(name: str, **changes: object) -> Trial:
    return Trial(name, "ramp", "surface_follow_sim.yaml", {**SHORT, **changes})


TWO = [trial("slow"), trial("fast", **{"task.speed_mm_s": 30})]


def duration(folder: RunFolder) -> Mapping[str, float]:
    task = folder.recording.series("/task")
    assert task is not None
    return {"run_s": float(folder.recording.during(task.t_s, "run").sum() / folder.plan.cell.rate_hz), "never": np.nan}


def broken(folder: RunFolder) -> Mapping[str, float]:
    if folder.path.name == "fast":
        raise KeyboardInterrupt
    return duration(folder)


def test_changes_replace_the_keys_of_the_cell():
    data = trial("it").cell_data()
    assert data["task"]["distance_mm"] == 3
    assert data["sensors"]["sensor"]["estimator"] == {"kind": "true_contact"}
    with pytest.raises(ConfigError, match="no such section") as caught:
        trial("it", **{"tusk.depth_mm": 3}).cell_data()
    assert caught.value.key == "tusk.depth_mm"
    assert "task" in str(caught.value)


def test_trials_are_measured_kept_and_not_run_again(tmp_path):
    perform = Perform(duration, tmp_path)
    slow, fast = perform_all(perform, TWO)
    assert slow.done
    assert fast.done
    assert slow.measures["run_s"] == pytest.approx(3 / 20, abs=0.05)
    assert fast.measures["run_s"] < slow.measures["run_s"]
    assert "never" not in slow.measures
    before = (tmp_path / "slow" / "run.mcap").stat().st_mtime_ns
    changed = [TWO[0], trial("fast", **{"task.speed_mm_s": 25})]
    again = perform_all(perform, changed)
    assert again[0].measures == slow.measures
    assert (tmp_path / "slow" / "run.mcap").stat().st_mtime_ns == before
    assert fast.measures["run_s"] < again[1].measures["run_s"] < slow.measures["run_s"]


def test_an_interrupt_keeps_what_had_finished(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        perform_all(Perform(broken, tmp_path), TWO)
    assert (tmp_path / "slow" / "trial.json").exists()
    assert not (tmp_path / "fast" / "trial.json").exists()
    assert Perform(duration, tmp_path).kept(TWO[0]) is not None
    assert [finished.trial.name for finished in perform_all(Perform(duration, tmp_path), TWO)] == ["slow", "fast"]


def test_parallel_trials_give_the_same_results(tmp_path):
    alone = perform_all(Perform(duration, tmp_path / "alone"), TWO)
    beside = perform_all(Perform(duration, tmp_path / "beside"), TWO, workers=Workers(jobs=2))
    assert [each.measures for each in alone] == [each.measures for each in beside]
    recordings = [list(read(tmp_path / where / "fast" / "run.mcap")) for where in ("alone", "beside")]
    # The duration of a cycle depends on the machine.
    same = [[message for message in messages if message.topic != "/timing"] for messages in recordings]
    assert same[0] == same[1]


PLANTED = [
    Row("square, mdf", ({"error_mm": 1.0, "toppled": 0.0}, {"error_mm": 2.0, "toppled": 1.0}), 2),
    Row("round, foam", ({"error_mm": 0.5}, {}), 1),
]
COLUMNS = (Column("error_mm", "error mm", digits=1, below=2.0), Column("toppled", "toppled", "count"))
PAPER = {"square, mdf": "< 5 mm"}


def test_table_shows_statistics_aims_and_the_papers_figure():
    lines = table("pushing", PLANTED, COLUMNS, PAPER).splitlines()
    assert lines[0] == "pushing"
    assert lines[1].split() == ["done", "error", "mm", "toppled", "paper"]
    assert lines[2].split() == ["square,", "mdf", "2/2", "1.5", "±", "0.7!", "1", "of", "2", "<", "5", "mm"]
    assert lines[3].split() == ["round,", "foam", "1/2", "0.5", "-"]
    assert lines[4].split() == ["aim", "<", "2"]
    assert "misses its limit" in lines[5]


def test_table_for_machines_has_every_value():
    square = to_json(PLANTED, COLUMNS, PAPER)["square, mdf"]
    assert square["error_mm"] == {"mean": 1.5, "sd": pytest.approx(np.sqrt(0.5)), "worst": 2.0, "values": [1.0, 2.0]}
    assert (square["trials"], square["done"], square["paper"]) == (2, 2, "< 5 mm")


def test_an_experiment_leaves_table_and_pictures(tmp_path):
    def draw(finished: list[Finished], folder: Path) -> list[Path]:
        (folder / "it.png").write_text(" ".join(each.trial.name for each in finished))
        return [folder / "it.png"]

    tiny = ExperimentSpec("tiny", "two ways", lambda scale: TWO, duration, (Column("run_s", "s"),), draw)
    text = run_experiment(tiny, tmp_path, Scale()).text
    assert (tmp_path / "summary.txt").read_text() == text + "\n"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["experiment"] == "tiny"
    assert len(summary["rows"]["ramp"]["run_s"]["values"]) == 2
    assert (tmp_path / "it.png").read_text() == "slow fast"


def test_scale_counts_repetitions():
    assert [Scale().repetitions(5), Scale(quick=True).repetitions(5), Scale(3, quick=True).repetitions(5)] == [5, 1, 3]


@pytest.mark.parametrize("name", EXPERIMENTS.names())
def test_every_trial_of_every_experiment_is_a_valid_cell(name, tmp_path):
    import yaml

    from touchcell.cell.config.schema import plan_cell

    experiment = EXPERIMENTS.load(name)
    trials = experiment.trials(Scale())
    assert len({each.name for each in trials}) == len(trials)
    assert {each.row for each in experiment.trials(Scale(quick=True))} <= {each.row for each in trials}
    assert set(experiment.paper) <= {each.row for each in trials}
    for each in {each.row: each for each in trials}.values():
        (tmp_path / "cell.yaml").write_text(yaml.safe_dump(each.cell_data()))
        assert plan_cell(tmp_path / "cell.yaml").task.name
        assert (CONFIGS / each.cell).is_file()


def test_unknown_experiment_gets_a_suggestion(tmp_path, capsys):
    assert main(["experiment", "surface_folowing", "--out", str(tmp_path)]) == 2
    assert "surface_following" in capsys.readouterr().err


def test_an_unknown_executor_is_answered_with_a_suggestion(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'local'"):
        perform_all(Perform(duration, tmp_path), TWO, executor="locl")


def test_the_html_report_is_one_file_with_a_point_for_each_trial(tmp_path):
    pytest.importorskip("plotly", reason="pip install 'touchcell[html]'")
    tiny = ExperimentSpec("tiny", "two ways", lambda scale: TWO, duration, (Column("run_s", "s"),), lambda *_: [])
    result = run_experiment(tiny, tmp_path, Scale(), as_html=True)
    page = (tmp_path / "report.html").read_text()
    assert "report.html" in result.text
    for each in result.finished:
        assert page.count(each.trial.name) >= 3, "in a measure, among the paths, and in the table"
    assert "src='http" not in page
    assert 'src="http' not in page
