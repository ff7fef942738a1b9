"""``touchcell bench safety``: the fault matrix of ``benchmarks.fault_matrix``, and what the interlocks cost per cycle.

For each fault the time from its beginning to the trip, and the arm's time and way to rest, over all tasks and states;
the worst stop of each fault in each state; then the time of a supervisor's review by number of interlocks, and of the
gate.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml

from benchmarks.fault_matrix import FAULTS, Case, matrix
from benchmarks.provenance import provenance
from cell.cli import find_cell
from control.interlocks import REQUIRED_TO_MOVE, REQUIRED_TO_TOUCH, build_interlocks, parse_interlocks
from control.latch import Latch
from control.supervisor import Supervisor
from control.view import ArmView, CellView, SensorView
from drivers.clock import VirtualClock
from drivers.commands import Sent, TwistCommand, TwistFrame
from drivers.device import Lifecycle
from drivers.gate import TwistGate, TwistLimits
from drivers.lease import LeaseDesk
from drivers.samples import Stamped, TcpState
from geometry import se3

_REPEATS = 2000
_PERIOD_NS = 10_000_000


def run(arguments: Sequence[str], out: Path) -> None:
    """Print both tables; writes ``safety.json`` into ``out``. ``--processes``: see ``benchmarks.process_bench``."""
    parser = argparse.ArgumentParser("touchcell bench safety --")
    parser.add_argument("--processes", action="store_true", help="faults of whole processes, with two arms")
    parser.add_argument("--repeats", type=int, default=3, help="how often each fault of a process is tried")
    options = parser.parse_args(arguments)
    if options.processes:
        from benchmarks import process_bench

        process_bench.run(options.repeats, out)
        return
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        cases = list(matrix(Path(folder)))
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
    print(f"\nas it has to be: {len(cases) - len(bad)} of {len(cases)} places of the matrix, in {seconds:.0f} s")
    for case in bad:
        print(f"  {case.task}, {case.state}, {case.fault}: {case.problem}")
    costs = _costs()
    print(f"\n{'cost per cycle':<40}{'median us':>11}")
    for name, cost_us in costs.items():
        print(f"{name:<40}{cost_us:11.1f}")
    report = {**provenance(), "cases": [asdict(case) for case in cases], "cost_us": costs}
    (out / "safety.json").write_text(json.dumps(report, indent=1) + "\n")


def _row(name: str, cases: Sequence[Case]) -> str:
    detection = _quantiles([1e3 * c.detection_s for c in cases if c.detection_s is not None], 11, 8, 0)
    stop = _quantiles([1e3 * c.stop_s for c in cases if c.stop_s is not None], 10, 8, 0)
    way = _quantiles([1e3 * c.distance_m for c in cases if c.distance_m is not None], 10, 8, 2)
    by = ", ".join(sorted({case.ended_by or "-" for case in cases}))
    return f"{name:<26}{len(cases):>7}{detection}{stop}{way}  {by}"


def _worst(cases: Sequence[Case]) -> str:
    times = [case.stop_s for case in cases if case.stop_s is not None]
    ways = [case.distance_m for case in cases if case.distance_m is not None]
    words = f"{1e3 * max(times):.0f}" if times else "-"
    return f"{words + (f' / {1e3 * max(ways):.2f}' if ways else ' / -' if times else ''):>14}"


def _quantiles(values: Sequence[float], first: int, second: int, digits: int) -> str:
    if not values:
        return f"{'-':>{first}}{'-':>{second}}"
    return f"{np.median(values):{first}.{digits}f}{max(values):{second}.{digits}f}"


def _costs() -> dict[str, float]:
    """Microseconds of a review by number of interlocks in the shipped cell, and of the gate."""
    shipped = yaml.safe_load(find_cell(Path("configs/object_track_sim.yaml")).read_text())["interlocks"]
    names = list(shipped)
    views = _quiet_views()
    costs = {}

    def cost_us(chosen: Sequence[str]) -> float:
        section = {name: shipped[name] for name in chosen}
        supervisor = Supervisor(build_interlocks(parse_interlocks(section), {"sensor": np.eye(4)}), Latch())
        median_us = _median_us(lambda k: supervisor.review(views[k]))
        assert supervisor.latch.first_cause is None
        return median_us

    required = [n for n in names if shipped[n]["kind"] in REQUIRED_TO_MOVE | REQUIRED_TO_TOUCH]
    for chosen in ([], required, names):
        costs[f"review, {len(chosen)} interlocks and finite"] = cost_us(chosen)
    bare = costs["review, 0 interlocks and finite"]
    for name in names:
        costs[f"  of it {shipped[name]['kind']}"] = round(max(0.0, cost_us([name]) - bare), 2)
    costs["gate"] = _median_us(_Gate())
    return costs


def _median_us(call: Callable[[int], object]) -> float:
    times = []
    for k in range(_REPEATS):
        started = time.perf_counter_ns()
        call(k)
        times.append(time.perf_counter_ns() - started)
    return round(1e-3 * float(np.median(times)), 2)


def _quiet_views() -> list[CellView]:
    """A cell with one moving arm and one sensor in contact, cycle after cycle."""
    T = se3.from_euler_mm_deg(np.array([0.0, 0.0, 25.0, 180.0, 0.0, 0.0]))
    twist = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
    views = []
    for k in range(_REPEATS):
        now_ns = k * _PERIOD_NS
        command = TwistCommand(twist, TwistFrame.BASE, now_ns, 0.03)
        arm = ArmView(Stamped(TcpState(T, twist), now_ns, k), command, Sent(command, now_ns))
        sensor = SensorView(now_ns, k, True, 3e-3, True, 6.0, 3e-4, 1e-3, 0.0, k, 70.0)
        views.append(CellView(now_ns, {"arm": arm}, {"sensor": sensor}, "run"))
    return views


class _Gate:
    """A gate that turns a twist along tool axes and limits nothing."""

    def __init__(self) -> None:
        self._clock = VirtualClock()
        desk = LeaseDesk("arm")
        self._gate = TwistGate("arm", TwistLimits(0.1, 10.0, 1.0, 100.0, 1e4, 1e5), desk, self._clock)
        self._lease = desk.acquire("bench")
        self._T = np.eye(4)

    def __call__(self, k: int) -> None:
        self._clock.advance_s(0.01)
        twist = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
        command = TwistCommand(twist, TwistFrame.TCP, self._clock.now_ns(), 0.03)
        self._gate.admit(command, self._lease, Lifecycle.ACTIVE, self._T)
