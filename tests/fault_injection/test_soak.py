"""The counters of ``touchcell bench soak``, and a soak of half a minute."""

from __future__ import annotations

import json
import os
from pathlib import Path

from tests.fault_injection.soak import Held, Lap, held, judged
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main


def test_what_leaks_is_counted(tmp_path: Path) -> None:
    before = held()
    files = [os.open(tmp_path / str(k), os.O_CREAT) for k in range(3)]
    after = held()
    for file in files:
        os.close(file)
    assert after.descriptors == before.descriptors + 3
    assert held().descriptors == before.descriptors


def test_growth_is_reported_per_hour_after_the_warm_up() -> None:
    laps = [Lap(360.0 * k, "done", "", Held(100.0 + 0.5 * k, 10 + (k > 5), 1, 0)) for k in range(1, 11)]
    laps[4] = Lap(laps[4].cell_s, "tripped", "arm: stale", laps[4].held, "an arm is not at rest")
    summary = judged(laps)
    assert summary["memory growth after warm-up, MB per hour"] == 5.0
    assert summary["descriptors more than after warm-up"] == 1
    assert (summary["runs with a fault"], summary["runs that tripped"], summary["runs with a problem"]) == (1, 1, 1)


def test_a_short_soak_leaks_nothing_and_has_no_problem(tmp_path: Path) -> None:
    arguments = ["--", "--hours", "0.012", "--cell", "configs/surface_follow_sim.yaml"]
    assert main(["bench", "soak", "--out", str(tmp_path), *arguments]) == EXIT_OK
    summary = json.loads((tmp_path / "soak.json").read_text())["summary"]
    assert summary["runs with a problem"] == 0
    assert summary["runs with a fault"] > 0
    assert summary["descriptors more than after warm-up"] == 0
    assert summary["threads more than after warm-up"] == 0
    assert (tmp_path / "soak.png").stat().st_size > 0
