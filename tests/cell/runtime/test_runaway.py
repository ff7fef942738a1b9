"""A camera that is mounted turned gives estimates that look like any others: the arm must not servo on them."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.paths import CONFIGS
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import TipParameters
from touchcell.simulation.tip_file import TipFile, save_tip
from touchcell.tasks.interface import TransitionRecord


def _tip(folder: Path, turn_deg: float = 0.0, shift_px: tuple[float, float] = (0.0, 0.0), zoom: float = 1.0) -> str:
    """Write a tip whose camera is turned about its own axis, which out of contact shows the same image; or moved."""
    tip = TipParameters()
    u, v = tip.centre_px
    changed = replace(
        tip,
        image_rotation_rad=tip.image_rotation_rad + radians(turn_deg),
        centre_px=(u + shift_px[0], v + shift_px[1]),
        focal_px=tip.focal_px * zoom,
    )
    path = folder / "tip.yaml"
    save_tip(TipFile(tip=changed, rig=MountModel()), path)
    return str(path)


def _run(folder: Path, tip: str, **task: Any) -> tuple[list[TransitionRecord], float, str]:
    """Run surface following; return its transitions, the largest tilt in deg, and the result's reason."""
    data = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    data["sensors"]["sensor"]["tip"] = tip
    data["task"].update(task)
    file = folder / "cell.yaml"
    file.write_text(yaml.safe_dump(data))
    cell = compose(plan_cell(file))
    most_deg = 0.0
    with cell:
        loop = RunLoop(cell, None)
        loop.begin()
        while loop.step():
            T = cell.arms["arm"].tcp().value.T_base_tcp
            most_deg = max(most_deg, float(np.degrees(np.arccos(np.clip(-T[2, 2], -1.0, 1.0)))))
        result = loop.end()
    return list(cell.task.transitions), most_deg, result.reason


@pytest.mark.parametrize("turn_deg", [180.0, 60.0, -120.0])
def test_camera_turned_about_its_axis_trips_before_the_arm_tilts(tmp_path: Path, turn_deg: float) -> None:
    transitions, most_deg, _ = _run(tmp_path, _tip(tmp_path, turn_deg))
    assert (transitions[-1].source, transitions[-1].target) == ("check", "tripped")
    assert "turned by about" in transitions[-1].reason
    found = float(transitions[-1].reason.split("about ")[1].split(" deg")[0])
    assert abs((abs(found) - abs(turn_deg) + 180.0) % 360.0 - 180.0) < 25.0
    assert most_deg < 3.0


@pytest.mark.parametrize("moved", [{"zoom": 1.04}, {"shift_px": (9.0, -6.0)}])
def test_moved_camera_is_undone_and_the_run_ends_as_ever(tmp_path: Path, moved: dict[str, Any]) -> None:
    transitions, most_deg, _ = _run(tmp_path, _tip(tmp_path, **moved), distance_mm=20.0)
    assert [record.target for record in transitions][-1] == "done"
    assert most_deg < 30.0


def test_camera_that_moved_far_is_refused_before_anything_moves(tmp_path: Path) -> None:
    transitions, most_deg, reason = _run(tmp_path, _tip(tmp_path, shift_px=(40.0, 0.0)))
    assert not transitions
    assert "its camera is not the model's" in reason
    assert most_deg < 1e-6
