"""Devices that are no arms stop with the arms, and the run waits until they are at rest."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.helpers.pushing_cell import cell_file
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, RunResult
from touchcell.cell.runtime.stop_procedure import DEVICE_REST_S
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import DeviceFault
from touchcell.drivers.core.protocols import StopCategory


class Turntable(Device):
    """Comes to rest some time after a stop, or never, or cannot be asked."""

    def __init__(self, clock: Clock, rest_s: float, error: Exception | None = None) -> None:
        super().__init__("turntable", clock)
        self._rest_s, self._error = rest_s, error
        self.stopped_ns: int | None = None
        self.asked_ns: list[int] = []

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        self.stopped_ns = self.stopped_ns or self._clock.now_ns()

    def at_rest(self) -> bool:
        self.asked_ns.append(self._clock.now_ns())
        if self._error is not None:
            raise self._error
        return self.stopped_ns is not None and (self.asked_ns[-1] - self.stopped_ns) * 1e-9 >= self._rest_s

    def _open(self) -> None: ...

    def _close(self) -> None: ...


def stopped(tmp_path: Path, rest_s: float, error: Exception | None = None) -> tuple[RunResult, Turntable]:
    """Return the result of a run that is stopped at work, and its turntable."""
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(cell_file("surface_follow_sim.yaml")))
    cell = compose(plan_cell(file))
    table = Turntable(cell.clock, rest_s, error)
    cell.auxiliaries = {"table": table}
    with cell:
        loop = RunLoop(cell, None)
        for _ in range(60):
            assert loop.step()
        return loop.end(), table


def test_a_run_ends_only_when_its_other_devices_are_at_rest(tmp_path: Path) -> None:
    result, table = stopped(tmp_path, rest_s=1.5)
    assert result.outcome is Outcome.STOPPED
    assert table.stopped_ns is not None
    assert (table.asked_ns[-1] - table.stopped_ns) * 1e-9 == pytest.approx(1.5, abs=0.0101)


@pytest.mark.parametrize("error", [None, DeviceFault("turntable", "blind"), ValueError("a value")])
def test_a_device_that_is_not_seen_at_rest_in_time_is_a_fault_and_the_run_ends(
    tmp_path: Path, error: Exception | None
) -> None:
    result, table = stopped(tmp_path, rest_s=1e9, error=error)
    assert result.outcome is Outcome.TRIPPED
    assert [(v.interlock, v.subject) for v in result.causes] == [("stop", "table")]
    assert table.stopped_ns is not None
    assert (table.asked_ns[-1] - table.stopped_ns) * 1e-9 == pytest.approx(DEVICE_REST_S, abs=0.0101)
