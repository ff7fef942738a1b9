"""``result.json`` of a run folder: how the run ended, and why."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.runtime.black_box import cause_record, stop_record
from touchcell.cell.runtime.run_result import Outcome, RunResult

RESULT: Final = "result.json"
KILLED: Final = "it was killed, crashed, or there was no memory left"
"""Why a run that is not in progress has no result."""


def read_record(file: Path) -> dict[str, Any]:
    """Return a record of a run, as of its result or its black box; empty where none can be read."""
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def result_record(plan: CellPlan, result: RunResult) -> dict[str, Any]:
    """Return the record of a run that has ended."""
    return {
        "cell": plan.cell.name,
        "task": plan.task.name,
        "outcome": result.outcome.value,
        "reason": result.reason,
        "rests_on": list(result.rests_on),
        "state": result.state,
        "duration_s": round(result.duration_s, 6),
        "cycles": result.cycles,
        "stops": {role: stop_record(report) for role, report in result.stops.items()},
        "resets": [
            {"operator": reset.operator, "causes": [cause_record(cause) for cause in reset.causes]}
            for reset in result.resets
        ],
        "skipped": list(plan.skipped),
        "stages_us": {stage: _quantiles_us(rows) for stage, rows in result.times.rows.items()},
    }


def not_started_record(plan: CellPlan, error: Exception) -> dict[str, Any]:
    """Return the record of a run whose task never started."""
    return {"cell": plan.cell.name, "task": plan.task.name, "outcome": Outcome.ERROR.value, "reason": str(error)}


def _quantiles_us(rows: Iterable[int]) -> dict[str, float]:
    ordered = sorted(rows)
    return {
        "median": round(ordered[len(ordered) // 2] * 1e-3, 1),
        "p99": round(ordered[min(len(ordered) - 1, round(0.99 * len(ordered)))] * 1e-3, 1),
        "count": len(ordered),
    }
