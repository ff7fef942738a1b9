"""``touchcell bench gdn-vs-cnn`` trains both kinds equally and resumes after an interruption."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.helpers.tactile_samples import write_split

pytest.importorskip("torch")

from benchmarks.gdn_vs_cnn import KINDS, run, summary
from touchcell.perception.models.model_file import load_model
from touchcell.perception.networks.scores import SCORE_NAMES


def test_both_kinds_are_trained_equally_and_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for split, n in (("train", 32), ("val", 12)):
        write_split(tmp_path / "data", split, n=n, seed=n)
    words = ["--data", str(tmp_path / "data"), "--seeds", "1", "--epochs", "1", "--size", "32"]
    words += ["--networks", str(tmp_path / "networks")]
    run(words, tmp_path / "out")
    result = json.loads((tmp_path / "out" / "gdn-vs-cnn.json").read_text())
    assert list(result["networks"]) == list(KINDS)
    files = sorted((tmp_path / "networks").glob("*.safetensors"))
    headers = {load_model(path).header.architecture.kind: load_model(path).header for path in files}
    assert set(headers) == set(KINDS)
    for name in ("seed", "epochs", "batch_size", "learning_rate", "shift_px", "images"):
        assert headers["gdn"].training[name] == headers["cnn"].training[name]
    stamps = [path.stat().st_mtime_ns for path in files]
    run(words, tmp_path / "out")
    assert [path.stat().st_mtime_ns for path in files] == stamps
    assert "gdn < cnn" in capsys.readouterr().out
    assert (tmp_path / "out" / "gdn-vs-cnn.png").stat().st_size > 5_000


def test_summary_is_mean_and_sample_deviation() -> None:
    rows = [dict.fromkeys(SCORE_NAMES, value) for value in (1.0, 2.0, 3.0)]
    assert summary(rows) == {name: {"mean": 2.0, "sd": 1.0} for name in SCORE_NAMES}
    assert summary(rows[:1])["z_mm"]["sd"] == 0.0
