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


@pytest.mark.slow
@pytest.mark.parametrize("name", SIMULATED)
def test_a_shipped_cell_ends_as_done(name: str, tmp_path: Path) -> None:
    data = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    assert data.get("time", "simulated") == "simulated"
    run = tc.run(name, out=tmp_path / "run")
    assert run.outcome == "done", run.reason
