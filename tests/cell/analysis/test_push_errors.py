"""A run's summary says where the object ended."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import yaml

from tests.helpers.pushing_cell import cell_file
from touchcell.cell.analysis.push_errors import push_errors
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.cli.main import main


def run_cell(tmp_path, **changes):
    data = cell_file(
        "single_push_sim.yaml", scene__step_ms=10, task__retract_mm=12, task__push_speed_mm_s=30, **changes
    )
    (tmp_path / "push.yaml").write_text(yaml.safe_dump(data))
    folder = tmp_path / "run"
    code = main(["run", str(tmp_path / "push.yaml"), "--out", str(folder)])
    return code, json.loads((folder / "summary.json").read_text()), folder


def last_object(folder):
    (series,) = [s for topic, s in RunFolder(folder).recording.topics.items() if topic.startswith("/objects/")]
    return np.array([series.column("x_mm")[-1], series.column("y_mm")[-1]])


def test_the_summary_begins_with_the_object(tmp_path, capsys):
    code, summary, folder = run_cell(tmp_path, task__target_mm=[100, 5], task__goal_heading_deg=5.0)
    assert code == 0
    # The object may move a little while the arm withdraws.
    distance_mm = float(np.linalg.norm(last_object(folder) - [100, 5]))
    assert summary["object_error_mm"] == pytest.approx(distance_mm, abs=0.5)
    assert summary["outcome"] == "done"
    assert math.isfinite(summary["object_heading_error_deg"])
    assert summary["target_error_mm"] < 5.0
    printed = capsys.readouterr().out.splitlines()
    assert f"object {summary['object_error_mm']:.1f} mm from the target" in printed[1]
    assert any("as far as object_center_offset_mm is right" in line for line in printed[2:6])


def test_a_push_that_is_given_up_says_how_far_off_the_object_is(tmp_path, capsys):
    """It lies farther aside than friction turns the object."""
    code, summary, _folder = run_cell(tmp_path, task__target_mm=[100, 200], task__contact_friction=0.1)
    assert code == 1
    assert summary["reason"].startswith("missed: the target cannot be reached")
    assert summary["object_error_mm"] > 50.0
    assert "object" in capsys.readouterr().out


def test_other_tasks_have_no_pushing_errors(tmp_path):
    cell = "surface_follow_sim.yaml"
    data = cell_file(cell, task__distance_mm=3)
    (tmp_path / "follow.yaml").write_text(yaml.safe_dump(data))
    assert main(["run", str(tmp_path / "follow.yaml"), "--out", str(tmp_path / "run")]) == 0
    assert push_errors(RunFolder(tmp_path / "run")) == {}
