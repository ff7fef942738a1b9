"""What the fixture ``cell`` costs: processor time until a cell in simulation is up, and of a whole test of a fault.

    python -m benchmarks cell-fixture [CELL ...] [--times N]

Up is from the call of the fixture to the first control cycle. The test of a fault runs the cell until its task works,
lets the arm's state grow old, waits for the trip and rest, and checks them. The first time includes importing modules
and reading models, which a session of tests pays for once.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.testing.cell_under_test import CellUnderTest

_CELLS: Final = {
    "surface_follow_sim.yaml": "approach",
    "surface_follow_bench.yaml": "approach",
    "object_track_panda_sim.yaml": "approach",
    "steps_damiao_bench.yaml": "touch",
    "dual_push_sim.yaml": "approach",
    "dual_push_bench.yaml": "approach",
}
"""Cells, each with a state in which its arms move."""


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``cell_fixture.json`` into ``out``."""
    parser = argparse.ArgumentParser("python -m benchmarks cell-fixture", description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="*", help="of those that it knows (default: all)")
    parser.add_argument("--times", type=int, default=9, help="repetitions (default: %(default)s)")
    options = parser.parse_args(arguments)
    print(
        f"{'processor time, s':<30}{'up: first':>10}{'best':>7}{'median':>8}{'fault: best':>13}{'median':>8}",
        flush=True,
    )
    rows: list[dict[str, Any]] = []
    for cell in options.cells or _CELLS:
        ups = [_processor_s(partial(_up, cell)) for _ in range(options.times)]
        faults = [_processor_s(partial(_fault, cell)) for _ in range(max(1, options.times // 3))]
        up, fault = _figures(ups[1:] or ups), _figures(faults)
        rows.append({"cell": cell, "first_s": ups[0], "up_s": up, "fault_s": fault})
        figures = f"{ups[0]:>10.2f}{up['best']:>7.2f}{up['median']:>8.2f}{fault['best']:>13.2f}{fault['median']:>8.2f}"
        print(f"{cell:<30}{figures}", flush=True)
    (out / "cell_fixture.json").write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


def _processor_s(work: Callable[[], None]) -> float:
    began_s = time.process_time()
    work()
    return time.process_time() - began_s


def _figures(values: Sequence[float]) -> dict[str, float]:
    return {"best": float(np.min(values)), "median": float(np.median(values))}


def _up(cell: str) -> None:
    with CellUnderTest(cell, on="sim"):
        pass


def _fault(cell: str) -> None:
    with CellUnderTest(cell, on="sim") as running:
        running.run_until(_CELLS[cell])
        running.inject(next(iter(running.cell.plan.arms)), stale=True)
        running.run_until_trip(limit_s=2.0)
        running.assert_tripped_by("arm_state_age")
        running.assert_nothing_sent_since_trip()
        running.assert_truly_stopped_as_declared()
