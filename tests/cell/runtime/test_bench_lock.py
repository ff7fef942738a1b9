"""Two sessions cannot have one bench."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchcell.cell.config.schema import plan_in_world
from touchcell.cell.runtime.bench_lock import BenchTaken, addresses, bench_lock
from touchcell.paths import CONFIGS


def test_two_cells_that_share_an_arm_exclude_each_other(tmp_path: Path) -> None:
    follow = plan_in_world(CONFIGS / "surface_follow_bench.yaml", "bench")
    steps = plan_in_world(CONFIGS / "steps_bench.yaml", "bench")
    push = plan_in_world(CONFIGS / "single_push_bench.yaml", "bench", settings={"sensors.sensor.device": "/dev/video9"})
    assert addresses(follow) == addresses(steps)
    with bench_lock(follow, tmp_path):
        with pytest.raises(BenchTaken, match="since") as taken, bench_lock(steps, tmp_path):
            pass
        assert taken.value.device == "arm"
        with bench_lock(push, tmp_path):
            pass
    with bench_lock(steps, tmp_path):
        pass
