"""Every simulated cell that ships does what its task promises."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import touchcell as tc
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
