"""Complete runs of pushing cells: the shipped cell files with the true contact, and the true final state."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.paths import CONFIGS


@cache
def _shipped(name: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((CONFIGS / name).read_text())
    return data


def cell_file(name: str, **changes: Any) -> dict[str, Any]:
    """Return a shipped cell file with the true contact; ``changes`` by key, with ``__`` between levels."""
    data = deepcopy(_shipped(name))
    for sensor in data["sensors"].values():
        sensor["estimator"] = {"kind": "true_contact"}
    for key, value in changes.items():
        *path, last = key.split("__")
        section = data
        for part in path:
            section = section[part]
        section[last] = value
    return data


@dataclass
class Pushed:
    """Result of a push.

    Attributes:
        result: result of the run.
        cell: cell of the run.
        error_mm: distance of the target from the true contact normal when pushing ended, positive to its left.
        object_mm_deg: x, y and yaw of the object at that time.
    """

    result: RunResult
    cell: Cell
    error_mm: float
    object_mm_deg: tuple[float, float, float]

    @property
    def path(self) -> list[tuple[str, str, str]]:
        """Return the task's transitions."""
        return [(r.source, r.event, r.target) for r in self.cell.task.transitions]


def push(
    data: dict[str, Any],
    tmp_path: Path,
    meanwhile: Callable[[Cell], None] | None = None,
    stop: StopRequest | None = None,
) -> Pushed:
    """Run the cell; ``meanwhile`` is called after every cycle."""
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(data))
    cell = compose(plan_cell(file))
    pusher = next(role for role in cell.sensors if not role.startswith("follower"))
    error_mm, at = math.nan, (math.nan, math.nan, math.nan)
    with cell:
        loop = RunLoop(cell, None, stop=stop)
        loop.begin()
        while loop.step():
            if meanwhile is not None:
                meanwhile(cell)
            if cell.task.state == "run":
                assert cell.scene is not None
                contact = cell.scene.contact(pusher).value
                n = contact.T_world_f[:2, 2] / np.linalg.norm(contact.T_world_f[:2, 2])
                d = 1e-3 * np.array(data["task"]["target_mm"]) - (contact.T_world_f @ contact.T_f_s)[:2, 3]
                error_mm = 1e3 * float(n[0] * d[1] - n[1] * d[0])
                (T,) = cell.scene.objects().value.values()
                at = 1e3 * T[0, 3], 1e3 * T[1, 3], math.degrees(math.atan2(T[1, 0], T[0, 0]))
        result = loop.end()
    return Pushed(result, cell, error_mm, at)
