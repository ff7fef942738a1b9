"""``touchcell bench filter`` takes its options after ``--`` and measures consistency and error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import filter_rivals, filter_tracking
from benchmarks.filter_sequences import filtered, single_frames, summary, synthetic
from tests.helpers.tactile_samples import write_split
from tests.perception.runtime.test_inference import constant_model
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.models.model_file import save_model
from touchcell.perception.runtime.filter import PoseFilter


def test_matched_noise_is_consistent_and_best() -> None:
    sequences = [synthetic(150, seed, 0.1) for seed in range(4)]
    rows = {level: summary(sequences, [filtered(s, level) for s in sequences]) for level in (1.0, 0.1, 0.01)}
    single = summary(sequences, [single_frames(s) for s in sequences])
    assert rows[0.1]["nees"]["low"] - 0.5 < rows[0.1]["nees"]["mean"] < rows[0.1]["nees"]["high"] + 0.5
    assert rows[0.1]["nis"]["low"] - 0.2 < rows[0.1]["nis"]["mean"] < rows[0.1]["nis"]["high"] + 0.2
    assert rows[0.01]["nis"]["mean"] > 8.0
    assert rows[1.0]["nis"]["mean"] < 4.0
    for name, error in single["mae"].items():
        assert rows[0.1]["mae"][name] < 0.8 * error
        assert rows[0.1]["mae"][name] < rows[0.01]["mae"][name]
        assert rows[0.1]["sigma"][name] < rows[1.0]["sigma"][name] < single["sigma"][name]


def test_rivals_agree_without_rotation() -> None:
    S = np.diag([1e-3] * 3 + [1e-4] * 3) ** 2
    prior, observation = (PoseGaussian(se3.exp(np.full(6, x)), S) for x in (1e-5, 3e-5))
    best = gaussian.fuse(prior, observation)[0]
    for name in ("gauss_newton", "extended_kalman", "naive"):
        fused = getattr(filter_rivals, name)(prior, observation)
        np.testing.assert_allclose(fused.mean, best.mean, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(fused.covariance, best.covariance, rtol=1e-4, atol=1e-13, err_msg=name)


def test_robust_corrections_recover_from_slip_sooner() -> None:
    S, jump = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2, se3.exp(np.array([2e-3, 0, 0, 0, 0, 0]))
    left = {}
    for make in (PoseFilter, filter_rivals.SlipFilter, filter_rivals.StudentFilter):
        pose_filter = make(np.zeros((6, 6)))
        for k in range(20):
            pose_filter.update(PoseGaussian(np.eye(4), S), np.eye(4), k)
        belief = pose_filter.update(PoseGaussian(jump, S), np.eye(4), 20).belief
        left[make.__name__] = 2e-3 - belief.mean[0, 3]
    assert left["SlipFilter"] < 0.6e-3 < 1.5e-3 < left["PoseFilter"] < left["StudentFilter"]


def test_options_follow_the_dashes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--", "--only", "steps", "--draws", "5"]
    assert main(["bench", "filter", "--out", str(tmp_path), *words]) == EXIT_OK
    result = json.loads((tmp_path / "filter.json").read_text())
    assert {row["method"] for row in result["corrections"]} >= {"naive, numpy", "Gauss-Newton, compiled"}
    assert "sequences" not in result
    assert (tmp_path / "filter_steps.png").stat().st_size > 10_000
    assert "order 4" in capsys.readouterr().out


@pytest.mark.slow
def test_a_labelled_split_is_a_sequence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_split(tmp_path / "data", "val", n=12, seed=0)
    model = tmp_path / "model.safetensors"
    save_model(constant_model("gdn", [0.0] * 12), model)
    words = ["--data", str(tmp_path / "data"), "--model", str(model), "--only", "sequences", "--orders", "2"]
    assert main(["bench", "filter", "--out", str(tmp_path / "out"), "--", *words]) == EXIT_OK
    sequences = json.loads((tmp_path / "out" / "filter.json").read_text())["sequences"]
    assert list(sequences) == ["order of the data set", "shuffled", "one frame in 10 torn"]
    assert [row["noise"] for row in sequences["shuffled"]][:5] == [None, 1.0, 0.3, 0.1, 0.03]
    ordered, shuffled, _ = (sequences[kind][0]["mae"] for kind in sequences)
    assert ordered == pytest.approx(shuffled)
    assert (tmp_path / "out" / "filter_consistency.png").is_file()
    assert "order of the data set: 1 x 12 contacts" in capsys.readouterr().out


def test_behind_a_moving_plate_the_moving_surface_model_does_not_lag() -> None:
    rows = {
        name: filter_tracking.track(name, moving=True, duration_s=14.0, seed=0) for name in ("still, drift 4", "moving")
    }
    assert [row["outcome"] for row in rows.values()] == ["done", "done"]
    for component, factor in (("x_mm", 0.6), ("y_mm", 0.6), ("alpha_deg", 0.9), ("gamma_deg", 0.9)):
        still, moving = (row["estimation"][component] for row in rows.values())
        assert moving < factor * still, component
