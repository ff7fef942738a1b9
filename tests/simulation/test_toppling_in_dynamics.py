"""A tall prism that is pushed too high in the dynamic world: the interlock stops the arm, or else the task does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, RunResult
from touchcell.paths import CONFIGS

SHIPPED = CONFIGS / "single_push_sim.yaml"
TOPPLING = {
    "kind": "toppling",
    "sensors": ["sensor"],
    "arms": ["arm"],
    "limit_deg": 5,
    "limit_deg_s": 10,
    "limit_mm": 3,
    "hold_ms": 100,
    "states": ["settle", "run"],
}


def pushed(folder: Path, interlock: dict[str, Any] | None) -> tuple[RunResult, float]:
    """Push a prism of 60 x 60 x 180 mm on foam at a height of 165 mm; return the result and the largest lean, deg."""
    data = yaml.safe_load(SHIPPED.read_text())
    data["scene"] |= {"physics": "dynamic", "table": {"friction": "foam"}}
    data["scene"]["objects"]["prism"]["shape"]["size_mm"] = [60, 60, 180]
    data["arms"]["arm"]["start_pose_mm_deg"] = [-55, 0, 165, 180, 0, 0]
    # Its edges are not felt first: high up a foam table lets it turn with the tip.
    data["task"]["sides"] = "round"
    put_on_true_contact(data)
    for entry in data["interlocks"].values():
        if entry["kind"] == "workspace":
            entry["max_mm"][2] = 300
    if interlock is not None:
        data["interlocks"]["toppling"] = interlock
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    cell = compose(plan_cell(path))
    assert cell.scene is not None
    leant_deg = 0.0
    with cell:
        loop = RunLoop(cell, None)
        loop.begin()
        going = True
        after = 50
        # Until the run ends and half a second longer, unless it has toppled already.
        while leant_deg < 45.0 and after:
            if going:
                going = loop.step()
            else:
                after -= 1
                cell.clock.sleep_until_ns(cell.clock.now_ns() + 10_000_000)
            (T_world_object,) = cell.scene.objects().value.values()
            leant_deg = max(leant_deg, float(np.degrees(np.arccos(min(1.0, T_world_object[2, 2])))))
        result = loop.end()
    return result, leant_deg


def test_it_trips_before_the_prism_falls(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    result, leant_deg = pushed(tmp_path, TOPPLING)
    assert result.outcome is Outcome.TRIPPED
    assert result.causes[0].interlock == "toppling"
    assert 5.0 < leant_deg < 9.0


def test_without_it_the_task_gives_up_a_little_later(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    result, leant_deg = pushed(tmp_path, None)
    assert result.outcome is Outcome.FAILED
    assert "the object topples" in result.reason
    assert 9.0 < leant_deg < 20.0
