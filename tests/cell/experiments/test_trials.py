"""Trials: what they depend on, what becomes of those that break, and workers that share no files."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from touchcell.cell.analysis.code_identity import code_identity
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.cli.main import main
from touchcell.cell.experiments.elsewhere import WorkerDiffers
from touchcell.cell.experiments.executors import Workers
from touchcell.cell.experiments.run_trials import perform_all
from touchcell.cell.experiments.runner import stale_note
from touchcell.cell.experiments.trials import LOG, Finished, Perform, Trial, files_named
from touchcell.cell.recording.mcap import read
from touchcell.paths import CONFIGS

SHORT = {
    "sensors.sensor.estimator": {"kind": "true_contact"},
    "task.distance_mm": 3,
    "task.retract_mm": 2,
    "task.settle_time_s": 0.05,
}


def trial(name: str, cell: str = "surface_follow_sim.yaml", **changes: object) -> Trial:
    return Trial(name, "ramp", cell, {**SHORT, **changes})


def cycles(folder: RunFolder) -> Mapping[str, float]:
    task = folder.recording.series("/task")
    assert task is not None
    return {"cycles": float(len(task.t_s))}


def breaking(folder: RunFolder) -> Mapping[str, float]:
    if folder.path.name == "raises":
        raise ValueError("nothing to measure")
    if folder.path.name == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    return cycles(folder)


def written_at(root: Path, name: str) -> int:
    return (root / name / "run.mcap").stat().st_mtime_ns


def test_a_trial_that_raises_dies_or_is_invalid_becomes_a_row_and_the_others_finish(tmp_path):
    trials = [trial(name) for name in ("a", "raises", "b", "dies", "c")]
    trials.append(trial("invalid", **{"task.depth_mm": -1}))
    finished = perform_all(Perform(breaking, tmp_path), trials, workers=Workers(jobs=2, time_limit_s=300.0))
    assert [(each.trial.name, each.outcome) for each in finished] == [
        ("a", "done"),
        ("raises", "crashed"),
        ("b", "done"),
        ("dies", "lost"),
        ("c", "done"),
        ("invalid", "invalid"),
    ]
    by_name = {each.trial.name: each for each in finished}
    assert "nothing to measure" in by_name["raises"].reason
    assert "Traceback" in (tmp_path / "raises" / LOG).read_text()
    assert "SIGKILL" in by_name["dies"].reason
    assert "depth_mm" in by_name["invalid"].reason
    before = written_at(tmp_path, "a")
    again = perform_all(Perform(cycles, tmp_path), trials[:2])
    assert [each.outcome for each in again] == ["done", "done"]
    assert written_at(tmp_path, "a") == before


def test_a_trial_of_other_code_is_run_again_unless_stale_ones_are_kept(tmp_path):
    only = [trial("it")]
    old = Perform(cycles, tmp_path, code=replace(code_identity(), digest="0" * 16, commit="0ld"))
    perform_all(old, only)
    before = written_at(tmp_path, "it")
    keeping = Perform(cycles, tmp_path, keep_stale=True)
    kept = perform_all(keeping, only)
    assert written_at(tmp_path, "it") == before
    assert stale_note(kept, keeping) == ["1 of the trials were run by other code, commit 0ld"]
    fresh = Perform(cycles, tmp_path)
    renewed = perform_all(fresh, only)
    assert written_at(tmp_path, "it") != before
    assert stale_note(renewed, fresh) == []
    record = json.loads((tmp_path / "it" / "trial.json").read_text())
    assert record["code"]["digest"] == code_identity().digest
    assert record["code"]["versions"]["numpy"]


def test_why_reads_how_a_trial_ended(tmp_path):
    from touchcell.cell.analysis.trip_report import explain

    far = trial("far", **{"task.approach_distance_mm": 1})
    (failed,) = perform_all(Perform(cycles, tmp_path), [far])
    assert failed.outcome == "failed"
    assert f"failed\n  {failed.reason}" in explain(tmp_path / "far", draw=False)


def follow_file(folder: Path) -> Path:
    """A cell with a tip file of its own beside it."""
    from touchcell.simulation.tip_file import SHIPPED as TIPS

    shutil.copy(next(TIPS.glob("*.yaml")), folder / "my_tip.yaml")
    text = (CONFIGS / "surface_follow_sim.yaml").read_text()
    assert "driver: sim_tactip" in text
    cell = folder / "cell.yaml"
    cell.write_text(text.replace("driver: sim_tactip", "driver: sim_tactip\n    tip: my_tip.yaml", 1))
    return cell


def test_a_trial_is_run_again_when_a_file_that_its_cell_names_changes(tmp_path):
    cell = follow_file(tmp_path)
    it = trial("it", str(cell))
    assert [path.name for path in files_named(it.cell_data())] == ["my_tip.yaml"]
    root = tmp_path / "trials"
    (first,) = perform_all(Perform(cycles, root), [it])
    assert first.outcome == "done"
    before = written_at(root, "it")
    perform_all(Perform(cycles, root), [it])
    assert written_at(root, "it") == before
    with (tmp_path / "my_tip.yaml").open("a") as file:
        file.write("# measured again\n")
    perform_all(Perform(cycles, root), [it])
    assert written_at(root, "it") != before


def recorded(root: Path, name: str) -> list[object]:
    # The duration of a cycle depends on the machine.
    return [message for message in read(root / name / "run.mcap") if message.topic != "/timing"]


@pytest.mark.parametrize(("executor", "module"), [("dask", "distributed"), ("ray", "ray"), ("slurm:local", "submitit")])
def test_workers_that_share_no_files_give_the_same_recordings(executor, module, tmp_path, monkeypatch):
    pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    trials = [trial("first", str(follow_file(tmp_path))), trial("second", **{"task.speed_mm_s": 30})]
    here = perform_all(Perform(cycles, tmp_path / "here"), trials)
    there = perform_all(Perform(cycles, tmp_path / "there"), trials, workers=Workers(jobs=2), executor=executor)
    assert [each.outcome for each in there] == ["done", "done"], [each.reason for each in there]
    assert [each.measures for each in there] == [each.measures for each in here]
    for each in trials:
        assert recorded(tmp_path / "there", each.name) == recorded(tmp_path / "here", each.name)
    before = written_at(tmp_path / "there", "first")
    perform_all(Perform(cycles, tmp_path / "there"), trials, executor=executor)
    assert written_at(tmp_path / "there", "first") == before


def test_an_invalid_trial_for_another_machine_is_named_here_and_not_sent(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.chdir(tmp_path)
    wrong = trial("wrong", **{"tusk.depth_mm": 1})
    (finished,) = perform_all(Perform(cycles, tmp_path / "there"), [wrong], executor="slurm:local")
    assert finished.outcome == "invalid"
    assert "tusk.depth_mm" in finished.reason


def test_a_record_names_the_files_of_this_machine_wherever_the_trial_ran(tmp_path):
    from touchcell.cell.experiments.elsewhere import RunElsewhere, parcel, unpack

    perform = Perform(cycles, tmp_path / "there")
    it = trial("it", str(follow_file(tmp_path)))
    unpack(perform, sent := parcel(it), RunElsewhere(cycles, perform.code)(sent))
    record = json.loads((tmp_path / "there" / "it" / "trial.json").read_text())
    assert list(record["files"]) == [str(tmp_path / "my_tip.yaml")]
    assert perform.kept(it) is not None


@pytest.mark.parametrize("keep_stale", [False, True])
def test_a_trial_of_version_0_1_is_run_again(tmp_path, keep_stale):
    it = trial("it")
    perform = Perform(cycles, tmp_path, keep_stale=keep_stale)
    perform_all(perform, [it])
    record = json.loads((tmp_path / "it" / "trial.json").read_text())
    del record["code"], record["files"]
    (tmp_path / "it" / "trial.json").write_text(json.dumps(record))
    assert perform.kept(it) is None


def test_a_worker_with_other_code_is_refused(tmp_path):
    from touchcell.cell.experiments.elsewhere import RunElsewhere, parcel, unpack

    mine = replace(code_identity(), digest="1" * 16, versions={**code_identity().versions, "numpy": "1.0"})
    perform = Perform(cycles, tmp_path, code=mine)
    sent = parcel(trial("it"))
    delivery = RunElsewhere(cycles, mine)(sent)
    with pytest.raises(WorkerDiffers, match="numpy") as caught:
        unpack(perform, sent, delivery)
    assert caught.value.there == code_identity()
    assert not (tmp_path / "it").exists()


def test_an_experiment_with_a_broken_trial_ends_with_an_exit_code_of_its_own(tmp_path, monkeypatch, capsys):
    from touchcell.cell.experiments.runner import EXPERIMENTS, ExperimentSpec

    def draw(finished: list[Finished], folder: Path) -> list[Path]:
        return []

    tiny = ExperimentSpec(
        "tiny", "two", lambda scale: [trial("good"), trial("bad", **{"task.depth_mm": -1})], cycles, (), draw
    )
    monkeypatch.setattr(type(EXPERIMENTS), "load", _load(type(EXPERIMENTS).load, tiny))
    assert main(["experiment", "tiny", "--out", str(tmp_path)]) == 1
    assert "ramp: invalid" in capsys.readouterr().out


def _load(load, tiny):
    return lambda registry, name: tiny if name == "tiny" else load(registry, name)
