"""Many trainings: one table, nothing trained twice, one that fails costs no other, and the same elsewhere."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip("torch")

from tests.helpers.tactile_samples import taught, write_split
from touchcell.cell.cli.main import main
from touchcell.cell.experiments.executors import Workers
from touchcell.cell.trainings.trainings import train_all, trainings, trainings_table
from touchcell.errors import ConfigError

QUICK = {"epochs": 1, "short_side_px": 32}


def write_data_set(folder: Path, images: int = 12) -> Path:
    for seed, split in enumerate(("train", "val")):
        write_split(folder, split, images, seed)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("data") / "tip")


def test_every_combination_is_trained_once_and_shown_in_one_table(data: Path, tmp_path: Path) -> None:
    wanted = trainings(["gdn", "cnn"], [data], range(2), QUICK)
    first = train_all(wanted, tmp_path)
    assert [each.training.name for each in first] == ["gdn_tip_0", "gdn_tip_1", "cnn_tip_0", "cnn_tip_1"]
    assert not any(each.reason for each in first)
    assert all({"z_mm", "nll"} <= set(each.scores) for each in first)
    models = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.safetensors")}
    assert len(models) == 4
    text = trainings_table(first)
    assert "gdn, tip" in text
    assert "2/2" in text
    again = train_all(wanted, tmp_path)
    assert again == first
    assert {path: path.stat().st_mtime_ns for path in models} == models


def test_other_settings_or_images_are_trained_again(data: Path, tmp_path: Path) -> None:
    [before] = train_all(trainings(["gdn"], [data], [0], QUICK), tmp_path / "models")
    [settings] = train_all(trainings(["gdn"], [data], [0], {**QUICK, "epochs": 2}), tmp_path / "models")
    assert settings.scores != before.scores
    other = write_data_set(tmp_path / "tip", images=11)
    [images] = train_all(trainings(["gdn"], [other], [0], QUICK), tmp_path / "models")
    assert images.scores != before.scores


def test_a_training_that_fails_costs_no_other(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["train", "--data", str(data), "--kind", "gdn", "markers", "--epochs", "1", "--jobs", "1"]
    assert main([*command, "--out", str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "markers_tip_0: " in printed
    assert "gdn, tip" in printed
    assert (tmp_path / "gdn_tip_0.safetensors").exists()
    assert not (tmp_path / "markers_tip_0.safetensors").exists()
    assert (tmp_path / "summary.txt").read_text() == printed


def test_two_data_sets_of_one_name_are_refused(data: Path, tmp_path: Path) -> None:
    other = write_data_set(tmp_path / "tip")
    with pytest.raises(ConfigError, match="two data sets are called tip"):
        train_all(trainings(["gdn"], [data, other], [0]), tmp_path / "models")


@pytest.mark.parametrize(("executor", "module"), [("dask", "distributed"), ("slurm:local", "submitit")])
def test_workers_that_share_no_files_train_the_same_model(
    executor: str, module: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    monkeypatch.chdir(tmp_path)
    wanted = trainings(["gdn"], [data], [3], QUICK)
    [here] = train_all(wanted, tmp_path / "here")
    [there] = train_all(wanted, tmp_path / "there", workers=Workers(1, 600.0), executor=executor)
    assert there == here
    assert taught(tmp_path / "there" / "gdn_tip_3.safetensors") == taught(tmp_path / "here" / "gdn_tip_3.safetensors")
