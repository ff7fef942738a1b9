"""``touchcell bench safety -- --processes``: every fault of a whole process while two arms move, and the cost.

For each fault, over all arms and repeats: the time until the arms were commanded to stop, from then to rest, the path
length since the fault, and the declared limits; then the cost of having arms in other processes.
"""

from __future__ import annotations

import functools
import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from tests.fault_injection.clock_step import STEPS_S, StepCase, clock_shim, run_steps
from tests.fault_injection.process_cost import measure
from tests.fault_injection.process_faults import FAULTS, ProcessCase, ProcessFault, TooBusy, run_fault
from touchcell.cell.bench.provenance import provenance

CELLS: Final = {
    "sway": (50.0, "two arms to and fro at 50 Hz, each in its own process"),
    "push": (12.5, "an emulated Franka and an emulated UR push an object at 12.5 Hz, each in its own process"),
}
"""Rate and description of each."""

_TRIES: Final = 8
# The loop's deadline is not tested there.
_CLOCK_HZ: Final = 25.0

T = TypeVar("T")


def run(repeats: int, out: Path) -> None:
    """Print both tables; write ``processes.json`` into ``out``."""
    reports: list[dict[str, Any]] = []
    problems: list[str] = []
    not_run = 0
    with tempfile.TemporaryDirectory() as folder:
        for what, (rate_hz, description) in CELLS.items():
            print(f"\n{description}; {repeats} times each; median and worst of all arms")
            print(f"{'':<20}{'detection, ms':>18}{'stop time, ms':>16}{'way, mm':>16}{'rest, ms':>10}{'declared':>10}")
            for fault in FAULTS:
                tried = [_case(Path(folder) / f"{what} {fault.name} {k}", fault, rate_hz, what) for k in range(repeats)]
                cases = [case for case in tried if case is not None]
                not_run += len(tried) - len(cases)
                print(_row(fault, cases), flush=True)
                problems += [f"{what}, {fault.name}: {problem}" for case in cases for problem in case.problems]
                reports += [{"cell": what, "rate_hz": rate_hz, **_record(case)} for case in cases]
            steps = _clock_steps(Path(folder), min(rate_hz, _CLOCK_HZ), what, repeats)
            problems += [f"{what}, clock step: {problem}" for step in steps for problem in step.problems]
            reports += [{"cell": what, "rate_hz": rate_hz, "fault": "clock step", **asdict(step)} for step in steps]
        if not_run:
            print(f"\nnot run, because the machine starved the cell before the fault: {not_run}")
        print(f"\n{len(problems)} problems" + "".join(f"\n  {problem}" for problem in problems))
        costs = {kind: measure(Path(folder), kind) for kind in ("one", "separate")}
    print(f"\n{'two arms at 100 Hz, us':<32}{'one process':>18}{'separate':>18}")
    for label, what in (("command to the arm's gate", "one_way"), ("cycle: read and send to both", "cycle")):
        rows = [getattr(costs[kind], what) for kind in ("one", "separate")]
        print(f"{label + ', p50 / p99':<32}" + "".join(f"{row['p50']:>9.0f} /{row['p99']:>7.0f}" for row in rows))
    report = {**provenance(), "cases": reports, "cost_us": {k: asdict(c) for k, c in costs.items()}}
    (out / "processes.json").write_text(json.dumps(report, indent=1) + "\n")


def _clock_steps(folder: Path, rate_hz: float, what: str, repeats: int) -> list[StepCase]:
    """Step the clock of all processes and print the results."""
    library = clock_shim(folder)
    if library is None:
        print("clock of all processes set: not run, there is no C compiler for tests/fault_injection/clock_shim.c")
        return []
    tried = [
        _tried(functools.partial(run_steps, library=library, rate_hz=rate_hz, what=what), folder / f"{what} clock {k}")
        for k in range(repeats)
    ]
    steps = [step for step in tried if step is not None]
    seen_s = ", ".join(sorted({f"{step.stepped_s:+.0f} s" for step in steps}))
    went_on = sum(not step.problems for step in steps)
    slowest_mm_s = 1e3 * min((speed for step in steps for speed in step.fastest_m_s), default=0.0)
    print(
        f"clock of all processes set {', '.join(f'{s:+d} s' for s in STEPS_S)}: went on in {went_on} of {len(steps)}, "
        f"arms at {slowest_mm_s:.0f} mm/s at least; seen by the task's wall clock: {seen_s}",
        flush=True,
    )
    return steps


def _case(folder: Path, fault: ProcessFault, rate_hz: float, what: str) -> ProcessCase | None:
    """Run one case; repeated where the machine starved the cell, None where it always did."""
    return _tried(lambda place: run_fault(place, fault, rate_hz, what), folder)


def _tried(attempt: Callable[[Path], T], folder: Path) -> T | None:
    for k in range(_TRIES):
        with suppress(TooBusy):
            return attempt(folder / str(k))
    return None


def _row(fault: ProcessFault, cases: Sequence[ProcessCase]) -> str:
    arms = [arm for case in cases for arm in case.arms]
    detection = _pair([1e3 * arm.detected_s for arm in arms if arm.detected_s is not None], 18, 0)
    stop = _pair([1e3 * arm.stop_s for arm in arms if arm.stop_s is not None], 16, 0)
    way = _pair([1e3 * arm.travelled_m for arm in arms], 16, 2)
    rest = max((1e3 * arm.rest_s for arm in arms if arm.rest_s is not None), default=None)
    declared = max((1e3 * case.declared_s for case in cases), default=0.0)
    return f"{fault.name:<20}{detection}{stop}{way}{'-' if rest is None else f'{rest:.0f}':>10}{declared:>10.0f}"


def _pair(values: Sequence[float], width: int, digits: int) -> str:
    text = f"{np.median(values):.{digits}f} / {max(values):.{digits}f}" if values else "-"
    return f"{text:>{width}}"


def _record(case: ProcessCase) -> dict[str, Any]:
    return {
        "fault": case.fault.name,
        "declared_s": case.declared_s,
        "arms": [asdict(arm) for arm in case.arms],
        "outcome": dict(case.outcome),
        "notes": dict(case.notes),
        "problems": list(case.problems),
    }
