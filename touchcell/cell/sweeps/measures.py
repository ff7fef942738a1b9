"""Named numbers of any run, whatever its task: duration, errors against the truth, and the task's own telemetry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from touchcell.cell.analysis.report import summarise
from touchcell.cell.analysis.run_folder import RunFolder


def run_measures(folder: RunFolder) -> Mapping[str, float]:
    """Return the numbers of a run.

    ``duration_s``; ``SENSOR.estimation.rms.z_mm`` and the like, as in the run's summary; for each number that the task
    reports, ``task.NAME.last`` and ``task.NAME.worst``, the largest magnitude while it ran.
    """
    run = folder.recording
    found = {name: value for name, value in _flat(summarise(run)["errors"]) if np.isfinite(value)}
    task = run.series("/task")
    if task is not None and len(task.t_s):
        found["duration_s"] = float(task.t_s[-1] - task.t_s[0])
        running = run.during(task.t_s, "run")
        for name in dict.fromkeys(name for row in task.rows for name in row):
            values = task.column(name)
            known = np.isfinite(values)
            if known.any():
                found[f"task.{name}.last"] = float(values[known][-1])
            if (known & running).any():
                found[f"task.{name}.worst"] = float(np.abs(values[known & running]).max())
    return found


def _flat(data: Mapping[str, Any], above: str = "") -> list[tuple[str, float]]:
    found: list[tuple[str, float]] = []
    for name, value in data.items():
        key = f"{above}{name}"
        if isinstance(value, Mapping):
            found += _flat(value, f"{key}.")
        elif isinstance(value, int | float):
            found.append((key, float(value)))
    return found
