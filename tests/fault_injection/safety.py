"""``touchcell bench safety``: the fault matrix of simulated devices, and the cost of the interlocks per cycle.

For each fault the time from its injection to the trip, and the arm's time and distance to rest, over all tasks and
states; the worst stop of each fault in each state; then the cost of gate and interlocks
(``tests.fault_injection.safety_cost``).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from tests.fault_injection.fault_matrix import FAULTS, Case, median_and_worst, places, run_place
from tests.fault_injection.safety_cost import costs
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.cli.workers import add_workers, workers_of
from touchcell.cell.experiments.executors import EXECUTORS, Lost
from touchcell.cell.experiments.remote_work import send_by_value

_REPEATS = 2000
_PERIOD_NS = 10_000_000


def run(arguments: Sequence[str], out: Path) -> None:
    """Print both tables; write ``safety.json`` into ``out``.

    ``--processes``: see ``tests.fault_injection.process_bench``. ``--cost``: only the cost of a cycle, into
    ``safety_cost.json``.
    """
    parser = argparse.ArgumentParser("touchcell bench safety --")
    parser.add_argument("--processes", action="store_true", help="faults of whole processes, with two arms")
    parser.add_argument("--repeats", type=int, default=3, help="repetitions of each fault of a process")
    parser.add_argument("--cost", action="store_true", help="only the cost of gate and interlocks per cycle")
    add_workers(parser, what="case")
    options = parser.parse_args(arguments)
    if options.processes:
        from tests.fault_injection import process_bench

        process_bench.run(options.repeats, out)
        return
    if options.cost:
        (out / "safety_cost.json").write_text(json.dumps({**provenance(), "cost_us": _print_costs()}, indent=1) + "\n")
        return
    started = time.perf_counter()
    cases = _run_all(options)
    print(f"{'':<26}{'places':>7}{'fault to trip, ms':>19}{'stop time, ms':>18}{'stop way, mm':>16}")
    print(f"{'fault':<26}{'':>7}{'median':>11}{'worst':>8}" + f"{'median':>10}{'worst':>8}" * 2 + "  ended by")
    for fault in FAULTS:
        print(_row(fault.name, [case for case in cases if case.fault == fault.name]))
    states = list(dict.fromkeys(case.state for case in cases))
    print(f"\n{'worst stop, ms and mm':<26}" + "".join(f"{state:>14}" for state in states))
    for fault in FAULTS:
        of_fault = [case for case in cases if case.fault == fault.name]
        print(f"{fault.name:<26}" + "".join(_worst([c for c in of_fault if c.state == state]) for state in states))
    bad = [case for case in cases if case.problem]
    seconds = time.perf_counter() - started
    print(f"\nas expected: {len(cases) - len(bad)} of {len(cases)} places of the matrix, in {seconds:.0f} s")
    for case in bad:
        print(f"  {case.task}, {case.device}, {case.state}, {case.fault}: {case.problem}")
    print()
    cost_us = _print_costs()
    report = {**provenance(), "cases": [asdict(case) for case in cases], "cost_us": cost_us}
    (out / "safety.json").write_text(json.dumps(report, indent=1) + "\n")


def _run_all(options: argparse.Namespace) -> list[Case]:
    """Run the matrix on an executor; a case whose worker was lost counts as one that did not end as expected."""
    wanted = list(places())
    name, _, address = options.executor.partition(":")
    send_by_value(run_place)
    found: dict[int, Case] = {}
    for index, case in EXECUTORS.load(name).run(run_place, wanted, replace(workers_of(options), address=address)):
        if isinstance(case, Lost):
            place = wanted[index]
            task = place.cell["task"]["name"]
            case = Case(task, place.device, place.fault, place.state, problem=case.reason)
        found[index] = case
    return [found[index] for index in range(len(wanted))]


def _print_costs() -> dict[str, float]:
    found = costs()
    print(f"{'cost per cycle':<64}{'us of CPU':>11}")
    for name, cost_us in found.items():
        print(f"{name:<64}{cost_us:11.1f}")
    return found


def _row(name: str, cases: Sequence[Case]) -> str:
    detection = median_and_worst([1e3 * c.detection_s for c in cases if c.detection_s is not None], 11, 8, 0)
    stop = median_and_worst([1e3 * c.stop_s for c in cases if c.stop_s is not None], 10, 8, 0)
    way = median_and_worst([1e3 * c.distance_m for c in cases if c.distance_m is not None], 10, 8, 2)
    by = ", ".join(sorted({case.ended_by or "-" for case in cases}))
    return f"{name:<26}{len(cases):>7}{detection}{stop}{way}  {by}"


def _worst(cases: Sequence[Case]) -> str:
    times = [case.stop_s for case in cases if case.stop_s is not None]
    ways = [case.distance_m for case in cases if case.distance_m is not None]
    text = f"{1e3 * max(times):.0f}" if times else "-"
    return f"{text + (f' / {1e3 * max(ways):.2f}' if ways else ' / -' if times else ''):>14}"
