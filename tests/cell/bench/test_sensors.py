"""``touchcell bench sensors``: two sensors in one real-time cell, perceived in the loop's thread and in their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from touchcell.cell.bench.sensors import measure
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main


def test_every_sensor_delivers_estimates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--", "--sensors", "2", "--rates", "30", "--seconds", "1.2"]
    assert main(["bench", "sensors", "--out", str(tmp_path), *words]) == EXIT_OK
    rows = json.loads((tmp_path / "sensors.json").read_text())["rows"]
    assert [(row["perceive_in"], row["threads"]) for row in rows] == [
        ("loop", False),
        ("threads", True),
        ("auto", True),
    ]
    for row in rows:
        # Of the sensor with the fewest estimates.
        assert row["estimates_per_s"] > 0.0
        assert 0.0 < row["new_age_ms"]["median"] <= row["new_age_ms"]["p99"]
    assert "auto, threads" in capsys.readouterr().out


def test_a_failed_thread_raises_in_the_loop(tmp_path: Path) -> None:
    (tmp_path / "frame_0.jpg").write_bytes(b"no image")
    for where in ("loop", "threads"):
        with pytest.raises(Exception, match="not a complete"):
            measure(tmp_path, 1, 30.0, 1.0, "builtin:sim_gdn", where)
