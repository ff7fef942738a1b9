"""How far two runs of one cell were apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from touchcell.cell.analysis.run_data import load_run
from touchcell.cell.bench.jogged import jog_run
from touchcell.cell.bench.worlds import apart, visits_to
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.runtime.run_result import Outcome
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS


def way(begin_s: float, end_s: float, late_s: float = 0.0, aside_mm: float = 0.0) -> Array:
    """A tool that goes along x at 10 mm/s from ``begin_s`` on."""
    t_s = np.arange(begin_s, end_s, 0.02)
    zero = np.zeros_like(t_s)
    return np.column_stack([t_s, 10.0 * (t_s - begin_s - late_s), zero + aside_mm, zero])


def test_a_task_that_comes_back_to_its_work_later_in_one_world_is_compared_visit_by_visit() -> None:
    def visits(second_s: float) -> list[Array]:
        between = way(1.0, second_s)
        rows = np.vstack([way(0.0, 1.0), between, way(second_s, second_s + 3.0)])
        inside = np.ones(len(rows), dtype=bool)
        inside[50 : 50 + len(between)] = False
        return visits_to(rows, inside)

    one, other = visits(2.0), visits(3.5)
    assert [each[0, 0] for each in one] == [0.0, 0.0]
    found = apart({"arm": one}, {"arm": other})
    assert found is not None
    assert found.rms_mm == pytest.approx(0.0, abs=1e-6)


def test_a_lag_is_found_as_a_shift_and_an_offset_is_left() -> None:
    found = apart({"arm": [way(0.0, 4.0)]}, {"arm": [way(0.0, 4.0, late_s=0.05, aside_mm=0.3)]})
    assert found is not None
    assert found.rms_mm == pytest.approx(np.hypot(0.5, 0.3), abs=1e-3)
    assert found.shift_s == pytest.approx(0.05)
    assert found.shifted_rms_mm == pytest.approx(0.3, abs=1e-3)


def test_visits_that_are_over_at_once_are_not_compared() -> None:
    assert visits_to(way(0.0, 1.0), np.zeros(50, dtype=bool)) == []
    assert apart({"arm": [way(0.0, 0.1)]}, {"arm": [way(0.0, 0.1)]}) is None
    assert apart({"arm": [way(0.0, 1.0)]}, {"other": [way(0.0, 1.0)]}) is None


def test_a_cell_is_jogged_by_a_script_until_it_touches_and_away_again(tmp_path: Path) -> None:
    result = jog_run(CONFIGS / "surface_follow_bench.yaml", "sim", tmp_path)
    assert (result.outcome, result.reason) == (Outcome.DONE, "operator")
    task = load_run(tmp_path / RECORDING).series("/task")
    assert task is not None
    states = [row["state"] for row in task.rows]
    visited = [state for state, before in zip(states, [None, *states], strict=False) if state != before]
    held = ["moving", "idle", "moving", "idle", "until_touch", "release", "idle", "backing_off", "release", "idle"]
    assert visited == ["idle", *held, "done"]
