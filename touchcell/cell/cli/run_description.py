"""What a recording holds besides messages: the cell file, calibrations, digests of models, versions, clocks."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Final

from touchcell.cell.analysis.code_identity import digest_of
from touchcell.cell.analysis.provenance import commit
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.perception_threads import perception_line
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.cell import Cell
from touchcell.perception.runtime.network_estimator import NetworkEstimator, model_path

ABOUT: Final = "touchcell"
"""Name of the metadata record."""


def wall_clock_ns() -> int:
    """Return the wall clock, which dates a recording for people and viewers."""
    return time.time_ns()


def describe_run(recorder: Recorder, cell: Cell) -> None:
    """Write the cell file and calibrations as attachments, and the rest as one metadata record.

    Raises:
        RecordingError: as the recorder does.
    """
    plan, now_ns = cell.plan, cell.clock.now_ns()
    recorder.describe(
        ABOUT,
        {
            "cell": plan.cell.name,
            "task": plan.task.name,
            "world": plan.cell.world or "as written",
            "time": plan.cell.time,
            "seed": str(plan.cell.seed),
            "perceives": perception_line(plan),
            "touchcell": version("touchcell"),
            "commit": commit(),
            "python": platform.python_version(),
            "machine": platform.platform(),
            "wall_clock_start_ns": str(now_ns + recorder.wall_offset_ns),
            "cell_clock_start_ns": str(now_ns),
            **{f"model_of_{sensor}": f"{name} {digest_of(path)}" for sensor, name, path in _models(plan)},
        },
    )
    recorder.attach("cell.yaml", "application/yaml", plan.text().encode(), now_ns)
    for sensor, path in _calibrations(plan):
        recorder.attach(f"calibration_of_{sensor}{path.suffix}", "application/octet-stream", path.read_bytes(), now_ns)


def _models(plan: CellPlan) -> Iterator[tuple[str, str, Path]]:
    for name in plan.sensors:
        estimator = plan.cell.sensors[name].estimator
        if isinstance(estimator, NetworkEstimator):
            yield name, Path(estimator.model).name, model_path(estimator.model)


def _calibrations(plan: CellPlan) -> Iterator[tuple[str, Path]]:
    for name in plan.sensors:
        estimator = plan.cell.sensors[name].estimator
        if isinstance(estimator, NetworkEstimator) and estimator.calibration is not None:
            yield name, Path(estimator.calibration)
