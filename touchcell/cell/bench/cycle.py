"""``touchcell bench cycle``: duration of one control cycle from frame to twist, by stage, in a running cell.

The shipped surface-following cell runs once with the learned estimator and once on the true contact, in simulated time;
durations are measured inside the run loop around each stage. Rendering the simulated frame is not part of a real cell's
cycle and is listed separately, as ``read frame``.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop

# Stages of a cycle with a new frame that a real cell has as well.
_STAGES = ("preprocess", "infer", "filter", "task and control", "supervisor", "gate and send")


def run(arguments: Sequence[str], out: Path) -> None:
    """Print and plot the latency budget; write ``cycle.json`` and ``cycle.png`` into ``out``."""
    path = find_cell(Path(arguments[0]) if arguments else Path("configs/surface_follow_sim.yaml"))
    plan = plan_cell(path)
    cell = compose(plan)
    with tempfile.TemporaryDirectory() as folder, Recorder(Path(folder) / "run.mcap") as recorder, cell:
        result = RunLoop(cell, recorder).run()
    times_us = {stage: np.array(rows) * 1e-3 for stage, rows in result.times.rows.items()}
    rows = {stage: _row(times_us[stage]) for stage in (*_STAGES, "read frame", "record") if stage in times_us}
    total = sum(rows[stage]["median_us"] for stage in _STAGES if stage in rows)
    rows["frame in, twist out"] = {
        "median_us": total,
        "p99_us": sum(rows[stage]["p99_us"] for stage in _STAGES if stage in rows),
        "times": rows.get("infer", rows["supervisor"])["times"],
    }
    from touchcell.cell.analysis.plots import plot_budget

    print(f"{'stage':<22}{'median us':>11}{'p99 us':>11}{'times':>8}")
    for stage, row in rows.items():
        print(f"{stage:<22}{row['median_us']:11.1f}{row['p99_us']:11.1f}{row['times']:8.0f}")
    report = {**provenance(), "cell": path.name, "outcome": result.outcome.value, "stages": rows}
    (out / "cycle.json").write_text(json.dumps(report, indent=1) + "\n")
    stages_ms = {stage: 1e-3 * times_us[stage] for stage in _STAGES if stage in times_us}
    plot_budget(stages_ms, out / "cycle.png", "one control cycle with a new frame, by stage")


def _row(times_us: np.ndarray) -> dict[str, float]:
    return {
        "median_us": float(np.median(times_us)),
        "p99_us": float(np.percentile(times_us, 99)),
        "times": float(len(times_us)),
    }
