"""Every cell that ships does in simulation what its task promises."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import touchcell as tc
from tests.helpers.sampling import sampled
from touchcell.cell.config.schema import plan_in_world
from touchcell.paths import CONFIGS

SIMULATED = sorted(
    file.stem
    for file in CONFIGS.glob("*_sim.yaml")
    # Data collection has thousands of contacts; tests/tasks has a few of them.
    if file.stem != "collect_sim"
)
LONG = ("dual_push_sim", "dual_push_tall_sim", "object_track_panda_sim")
"""Thousands of cycles of two arms, or of joints; cells like them run in tests/tasks."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.exhaustive] * (name in LONG)) for name in SIMULATED]
)
def test_a_shipped_cell_ends_as_done(name: str, tmp_path: Path) -> None:
    data = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    assert data.get("time", "simulated") == "simulated"
    run = tc.run(name, out=tmp_path / "run")
    assert run.outcome == "done", run.reason


# `observe` ends when it is told to.
ON_STAND_INS = sorted(
    {*CONFIGS.glob("*_bench.yaml"), *CONFIGS.glob("*_emulated.yaml")} - {CONFIGS / "observe_bench.yaml"}
)


@pytest.mark.slow
@pytest.mark.parametrize("file", sampled(ON_STAND_INS, 1), ids=lambda file: file.stem)
def test_a_shipped_bench_cell_ends_as_done_on_stand_ins(file: Path, tmp_path: Path) -> None:
    settings = {"task.samples": 4, "collect.data": str(tmp_path / "data")} if file.stem == "collect_bench" else {}
    run = tc.run(plan_in_world(file, "sim", settings=settings), out=tmp_path / "run")
    assert run.outcome == "done", run.reason
