"""What came close to its limit, and what tripped, out of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from touchcell.cell.analysis.limits import close_calls, tripped_quantity, watched_quantities
from touchcell.cell.analysis.run_data import Run, run_of
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import Message


@pytest.fixture(scope="module")
def plan() -> CellPlan:
    return plan_cell(find_cell(Path("configs/surface_follow_sim.yaml")))


def recorded(depth_mm: float, speed_mm_s: float, x_mm: float = 0.0) -> Run:
    """Return a run of two samples, the second as given."""
    messages = []
    for k, scale in ((1, 0.1), (2, 1.0)):
        t_ns = k * 10_000_000
        contact = {
            "z_mm": scale * depth_mm,
            "x_mm": 0.0,
            "y_mm": 0.0,
            "sigma_z_mm": 0.1,
            "nis": 1.0,
            "t_frame_ns": t_ns,
        }
        pose = {"x_mm": x_mm, "y_mm": 0.0, "z_mm": 50.0, "alpha_deg": 180.0, "beta_deg": 0.0, "gamma_deg": 0.0}
        messages += [
            Message("/sensors/sensor/contact", t_ns, contact),
            Message("/arms/arm/tcp", t_ns, {**pose, "speed_mm_s": scale * speed_mm_s}),
        ]
    return run_of(messages)


def test_what_came_close_is_named_with_its_limit_and_its_time(plan: CellPlan) -> None:
    (line,) = close_calls(recorded(depth_mm=4.5, speed_mm_s=20.0), plan)
    assert line == "close to a limit: depth of sensor 4.5 of 5 mm (90 %, `indentation`, at 0.01 s)"


def test_what_came_closest_is_named_where_nothing_came_close(plan: CellPlan) -> None:
    (line,) = close_calls(recorded(depth_mm=2.5, speed_mm_s=20.0), plan)
    assert line.startswith("nothing came close to a limit; closest: depth of sensor 2.5 of 5 mm (50 %")


def test_nothing_is_said_without_anything_recorded(plan: CellPlan) -> None:
    assert close_calls(run_of([]), plan) == []


def test_the_quantity_of_a_cause_is_found_by_its_interlock(plan: CellPlan) -> None:
    run = recorded(depth_mm=6.5, speed_mm_s=20.0)
    tripped = tripped_quantity(run, plan, {"interlock": "indentation", "subject": "sensor"})
    assert tripped is not None
    assert (tripped.limit, tripped.values[-1], tripped.unit) == (5.0, 6.5, "mm")
    assert tripped_quantity(run, plan, {"interlock": "device", "subject": "arm"}) is None


def test_a_workspace_is_a_distance_beyond_its_nearest_face(plan: CellPlan) -> None:
    rows = watched_quantities(recorded(1.0, 1.0, x_mm=260.0), plan)
    workspace = next(each for each in rows if each.interlock == "workspace")
    assert np.allclose(workspace.values, 10.0)
    assert workspace.limit == 0.0
