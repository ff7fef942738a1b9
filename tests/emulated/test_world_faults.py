"""A fault has one name in simulation and on emulators, and ends a cell in the same way."""

from __future__ import annotations

import os
from typing import Any

import pytest

from touchcell.errors import ConfigError
from touchcell.testing.cell_plugin import CellFactory
from touchcell.testing.cell_under_test import CellUnderTest

CELL = "surface_follow_bench.yaml"
SLOWLY = {"emulated_pace": 0.2, "task.distance_mm": 20}
_BUSY = 4.0


@pytest.fixture
def emulated(cell: CellFactory) -> CellUnderTest:
    pytest.importorskip("rtde_receive")
    if os.getloadavg()[0] > _BUSY * (os.cpu_count() or 1):
        pytest.skip("four processes keep no time on a machine as busy as this, not even a slow one")
    return cell(CELL, on="emulated", set=SLOWLY)


@pytest.mark.parametrize(
    ("device", "fault", "kind"),
    [("sensor", {"frozen": True}, "frame_frozen"), ("arm", {"stale": True}, "arm_state_age")],
)
def test_it_trips_the_same_interlock_and_the_arm_truly_stands_in_time(
    emulated: CellUnderTest, cell: CellFactory, device: str, fault: dict[str, Any], kind: str
) -> None:
    for running in (cell(CELL, on="sim", set={"task.distance_mm": 20}), emulated):
        running.run_until("run")
        running.inject(device, **fault)
        running.run_until_trip(limit_s=2.0)
        running.assert_tripped_by(kind)
        running.assert_nothing_sent_since_trip()
        running.assert_truly_stopped_as_declared()


def test_a_fault_that_the_emulator_does_not_have_is_named(emulated: CellUnderTest) -> None:
    with pytest.raises(ConfigError, match="no fault 'drift_m_s' on an emulated ur") as caught:
        emulated.inject("arm", drift_m_s=0.01)
    assert caught.value.key == "arm"
