"""A run on true contact whose operator is the test: it trips, waits, is reset and resumes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from tests.fault_injection.fault_matrix import cells
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest
from touchcell.cell.runtime.run_record import Box
from touchcell.cell.runtime.run_result import Progress, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.geometry.types import Array
from touchcell.simulation.devices.arm import SimArm


def waiting_cell(**changes: Any) -> dict[str, Any]:
    cell = cells()["surface_following"]
    cell["sensors"]["sensor"]["estimator"] = {"kind": "true_contact"}
    cell["on_trip"] = "wait_for_reset"
    cell["task"]["distance_mm"] = 4
    return {**cell, **changes}


class OperatedRun:
    """A cell whose operator is the test."""

    def __init__(
        self, folder: Path, cell: dict[str, Any] | None = None, *, operated: bool = True, box: Box | None = None
    ) -> None:
        path = folder / "cell.yaml"
        path.write_text(yaml.safe_dump(cell or waiting_cell()))
        self.cell: Cell = compose(plan_cell(path))
        self.channel = OperatorChannel()
        self.stop = StopRequest()
        self.trips: list[RunResult] = []
        self.waiting = ""
        self.loop = RunLoop(
            self.cell,
            None,
            box=box,
            stop=self.stop,
            on_cycle=self._note,
            channel=self.channel if operated else None,
            on_trip=self.trips.append,
        )
        self.cell.__enter__()
        arm = self.cell.arms["arm"]
        assert isinstance(arm, SimArm)
        self.arm = arm
        self.going = True

    def _note(self, progress: Progress) -> None:
        self.waiting = progress.waiting

    def go(self, cycles: int) -> None:
        for _ in range(cycles):
            self.going = self.going and self.loop.step()

    def until(self, state: str) -> None:
        for _ in range(2000):
            if self.cell.task.state == state:
                return
            self.go(1)
        raise AssertionError(f"still {self.cell.task.state}")

    def fault(self, **changes: Any) -> None:
        self.arm.faults = replace(self.arm.faults, **changes)

    def ask(self, ask: OperatorRequest) -> str:
        self.channel.last_reply = ""
        self.channel.ask(ask, "ada")
        self.go(1)
        return self.channel.last_reply

    def end(self) -> RunResult:
        result = self.loop.end()
        self.cell.__exit__(None, None, None)
        return result

    def pose(self) -> Array:
        return self.arm.T_world_tcp().copy()


def tripped(folder: Path, **changes: Any) -> OperatedRun:
    """A run whose arm stopped publishing its state in the middle of its task."""
    run = OperatedRun(folder, waiting_cell(**changes))
    run.until("run")
    run.go(20)
    run.fault(stale=True)
    run.until("tripped")
    return run
