"""Poses go into the cell file: its comments stay, and nothing is written that would not be a valid cell."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchcell.cell.config.jog_plan import jog_settings
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.teach import Teacher, changed_text
from touchcell.cell.runtime.worlds import plan_for
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.paths import CONFIGS

SHIPPED = sorted(path for path in CONFIGS.glob("*.yaml"))
POSE = se3.from_euler_mm_deg(np.array([10.004, -20.0, 30.25, 180.0, 0.0, 45.0]))


def teacher(path: Path) -> Teacher:
    settings, _ = jog_settings(path, None)
    return Teacher(
        path, plan_for(path, None, settings=settings), lambda changes: plan_for(path, None, settings=changes)
    )


def copied(folder: Path, name: str) -> Path:
    path = folder / name
    path.write_text((CONFIGS / name).read_text())
    return path


def changes(before: str, after: str) -> list[str]:
    found = difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0)
    return [line for line in found if line[0] in "+-" and not line.startswith(("+++", "---"))]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_file_keeps_its_form(path: Path) -> None:
    text = path.read_text()
    assert changed_text(text, {}) == text


@pytest.mark.parametrize(
    "text",
    [
        "a:\n- {b: 1}  # why\n- c\nd: [1, 2]\n",
        "a:\n    b:\n        - 1   # one\n        - 2\n    c: 'x'\n",
        '# head\n\na: 012\n\n\nb: "yes"   # quoted\n',
    ],
)
def test_other_styles_are_kept_too(text: str) -> None:
    assert changed_text(text, {}) == text
    added = [line.replace(" ", "") for line in changes(text, changed_text(text, {"new.key": [1, 2.5]}))]
    assert added == ["+new:", "+key:[1,2.5]"]


def test_a_start_pose_changes_one_line(tmp_path: Path) -> None:
    path = copied(tmp_path, "surface_follow_sim.yaml")
    path.write_text(path.read_text().replace("distance_mm: 180", "distance_mm: 30"))
    before = path.read_text()
    teacher(path).save("arm", "start", POSE)
    assert changes(before, path.read_text()) == [
        "-    start_pose_mm_deg: [-80, 0, 25, 180, 0, 0]",
        "+    start_pose_mm_deg: [10, -20, 30.25, 180, 0, 45]",
    ]
    assert plan_cell(path).cell.arms["arm"].start_pose_mm_deg == (10.0, -20.0, 30.25, 180.0, 0.0, 45.0)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_two_corners_make_a_box_in_whatever_order(tmp_path: Path) -> None:
    path = copied(tmp_path, "surface_follow_sim.yaml")
    first, second = (se3.from_euler_mm_deg(np.array([*p, 180.0, 0.0, 0.0])) for p in ([90, -40, 90], [-90, 45, 15]))
    teach = teacher(path)
    assert "first corner" in teach.save("arm", "corner", first)
    teach.save("arm", "corner", second)
    box: Any = plan_cell(path).cell.interlocks["workspace"]
    assert (box.min_mm, box.max_mm) == ((-90.0, -40.0, 15.0), (90.0, 45.0, 90.0))


def test_what_would_be_no_valid_cell_is_not_written(tmp_path: Path) -> None:
    path = copied(tmp_path, "surface_follow_sim.yaml")
    before = path.read_text()
    outside = se3.from_euler_mm_deg(np.array([900.0, 0.0, 25.0, 180.0, 0.0, 0.0]))
    with pytest.raises(ConfigError, match="outside"):
        teacher(path).save("arm", "start", outside)
    assert path.read_text() == before
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_step_and_a_pose_by_name(tmp_path: Path) -> None:
    path = copied(tmp_path, "steps_sim.yaml")
    text = path.read_text()
    path.write_text(f"{text}    - move: {{name: home, to_mm_deg: [0, 0, 40, 180, 0, 0]}}  # last\n")
    teach = teacher(path)
    teach.save("arm", "home", POSE)
    teach.save("arm", "corner_b", POSE)
    after = path.read_text()
    assert "to_mm_deg: [10, -20, 30.25, 180, 0, 45]} # last" in after
    assert "corner_b: &corner_b [10, -20, 30.25, 180, 0, 45]" in after
    assert plan_cell(path).cell.name == "steps_sim"


def test_a_surface_is_where_the_sensor_is(tmp_path: Path) -> None:
    path = copied(tmp_path, "collect_sim.yaml")
    teacher(path).save("arm", "surface", POSE)
    estimator: Any = plan_cell(path, to_run=False).cell.sensors["sensor"].estimator
    assert estimator.surface_mm_deg[:3] == (10.0, -20.0, 30.25)


def test_a_file_that_builds_on_another_gets_the_value_itself(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: surface_follow_sim.yaml\nname: mine  # my own\ntask: {distance_mm: 30}\n")
    teacher(path).save("arm", "start", POSE)
    assert "mine  # my own" in path.read_text()
    assert plan_cell(path).cell.arms["arm"].start_pose_mm_deg == (10.0, -20.0, 30.25, 180.0, 0.0, 45.0)


def test_a_shipped_file_is_left_alone() -> None:
    path = CONFIGS / "surface_follow_sim.yaml"
    with pytest.raises(ConfigError, match="ships with touchcell"):
        teacher(path).save("arm", "start", POSE)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_cell_can_be_moved_by_hand_or_says_why_not(path: Path) -> None:
    if path.stem in ("observe_bench", "replay_real"):
        with pytest.raises(ConfigError, match="no arm that can be moved by hand"):
            jog_settings(path, "sim")
        return
    settings, _ = jog_settings(path, "sim")
    plan = plan_for(path, "sim", settings=settings)
    assert plan.task.name == "jog"
    assert plan.task_config.model_dump()["speed_mm_s"] <= 50.0
