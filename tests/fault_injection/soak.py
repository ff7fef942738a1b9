"""``touchcell bench soak``: hours of cell time with random faults and operators, and resource leaks at the end.

Cells are run one after another in this process, each recorded and with a black box, as by ``touchcell run``. After
each run its arms must be at rest, no command may have been sent after a trip, and the process's resources are counted:
memory, file descriptors, threads, segments of shared memory.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import yaml

from tests.fault_injection.fault_matrix import FAULTS, Fault, on_true_contact, plan_anew
from tests.fault_injection.sent_commands import SentCommands
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.black_box import BlackBox
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.errors import TouchcellError
from touchcell.paths import CONFIGS
from touchcell.simulation.devices.arm import SimArm

_SAMPLES = 10
_ROWS = 12
# The first runs import modules and fill caches.
_WARM_UP = 0.2


@dataclass(frozen=True, slots=True)
class Held:
    """Resources of a process."""

    memory_mb: float
    descriptors: int
    threads: int
    segments: int


@dataclass(frozen=True, slots=True)
class Lap:
    """One run of a cell.

    Attributes:
        cell_s: cell time of all runs up to its end.
        outcome: outcome of the run.
        fault: the injected fault; empty if none.
        held: the process's resources afterwards.
        problem: deviation from the expected behaviour; empty if none.
    """

    cell_s: float
    outcome: str
    fault: str
    held: Held
    problem: str = ""


def held() -> Held:
    """Return the resources of this process after a garbage collection."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    shm = Path("/dev/shm")
    return Held(
        memory_mb=pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        descriptors=len(os.listdir("/proc/self/fd")),
        threads=threading.active_count(),
        segments=len(list(shm.iterdir())) if shm.is_dir() else 0,
    )


def lap(path: Path, folder: Path, rng: np.random.Generator, before_s: float = 0.0) -> Lap:
    """Run the cell file ``path`` once, with a fault at a random time in three runs of four.

    Args:
        path: the cell file, of simulated devices.
        folder: for the recording, which is overwritten.
        rng: selects fault and time.
        before_s: cell time of earlier runs.
    """
    cell, stop, box = compose(plan_anew(path)), StopRequest(), BlackBox(about={"cell": path.name})
    sent = SentCommands(box)
    places = [(fault, device) for fault in FAULTS for device in _targets(fault, cell)]
    fault, device = places[rng.integers(len(places))] if places and rng.random() < 0.75 else (None, "")
    after = int(rng.integers(1, 1500))
    with Recorder(folder / "run.mcap") as recorder, box, cell:
        loop = RunLoop(cell, recorder, box=sent, stop=stop)
        loop.begin()
        cycles = 0
        while loop.step():
            cycles += 1
            if fault is not None and cycles == after:
                fault.inject(cell, stop, device)
        result = loop.end()
        stands = all(arm.at_rest() for arm in cell.arms.values())
        if result.outcome is Outcome.TRIPPED:
            box.dump(folder, result)
    problem = "" if stands else "an arm is not at rest"
    if result.causes and sent.since(result.causes[0].t_ns):
        problem = "a command was sent after the trip"
    injected = fault.name if fault is not None and cycles >= after else ""
    return Lap(before_s + result.duration_s, result.outcome.value, injected, held(), problem or _unexpected(result))


def _targets(fault: Fault, cell: Cell) -> list[str]:
    """Return the devices that can have the fault: jointed arms are simulated without faults."""
    if fault.device == "camera":
        return list(cell.cameras)
    return [role for role, arm in cell.arms.items() if isinstance(arm, SimArm)]


def _unexpected(result: RunResult) -> str:
    known = result.error is None or isinstance(result.error, TouchcellError)
    return "" if known else f"raised {result.error!r}"


def run(arguments: Sequence[str], out: Path) -> None:
    """Run for ``--hours`` of cell time; print a table, write ``soak.json`` and ``soak.png`` into ``out``."""
    parser = argparse.ArgumentParser("touchcell bench soak")
    parser.add_argument("--hours", type=float, default=1.0, help="of cell time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cell", type=Path, action="append", help="cell file (default: all shipped simulated ones)")
    parser.add_argument(
        "--learned", action="store_true", help="keep the cells' estimators in place of the true contact"
    )
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    laps: list[Lap] = []
    print(f"{'cell time, h':>12}{'runs':>7}{'memory, MB':>12}{'descriptors':>13}{'threads':>9}{'segments':>10}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = [_prepared(path, folder, learned=options.learned) for path in options.cell or simulated_cells()]
        end_s = 3600.0 * options.hours
        shown = 0
        try:
            while not laps or laps[-1].cell_s < end_s:
                before_s = laps[-1].cell_s if laps else 0.0
                laps.append(lap(paths[len(laps) % len(paths)], folder, rng, before_s))
                if laps[-1].cell_s >= end_s * shown / _ROWS:
                    shown = int(_ROWS * laps[-1].cell_s / end_s) + 1
                    _print_row(laps)
        except KeyboardInterrupt:
            print("interrupted: results of the runs so far")
    summary = judged(laps)
    print()
    for what, value in summary.items():
        print(f"{what:<44}{value}")
    for each in laps:
        if each.problem:
            print(f"  at {each.cell_s:.0f} s, {each.fault or 'no fault'}: {each.problem}")
    rows = [asdict(each) for each in laps]
    (out / "soak.json").write_text(json.dumps({**provenance(), "summary": summary, "laps": rows}, indent=1) + "\n")
    _plot(laps, out / "soak.png")


def judged(laps: Sequence[Lap]) -> dict[str, float | int]:
    """Return the growth since the warm-up, and the number of problems."""
    warm = laps[int(_WARM_UP * len(laps)) :]
    hours = np.array([each.cell_s for each in warm]) / 3600.0
    memory = np.array([each.held.memory_mb for each in warm])
    slope = float(np.polyfit(hours, memory, 1)[0]) if len(warm) > 2 else 0.0
    return {
        "cell time, h": round(laps[-1].cell_s / 3600.0, 3),
        "runs": len(laps),
        "runs with a fault": sum(bool(each.fault) for each in laps),
        "runs that tripped": sum(each.outcome == Outcome.TRIPPED.value for each in laps),
        "runs with a problem": sum(bool(each.problem) for each in laps),
        "memory growth after warm-up, MB per hour": round(slope, 3),
        "descriptors more than after warm-up": warm[-1].held.descriptors - warm[0].held.descriptors,
        "threads more than after warm-up": warm[-1].held.threads - warm[0].held.threads,
        "segments more than after warm-up": warm[-1].held.segments - warm[0].held.segments,
    }


def _print_row(laps: Sequence[Lap]) -> None:
    now = laps[-1].held
    print(
        f"{laps[-1].cell_s / 3600.0:12.3f}{len(laps):7}{now.memory_mb:12.1f}{now.descriptors:13}{now.threads:9}"
        f"{now.segments:10}",
        flush=True,
    )


def simulated_cells() -> list[Path]:
    """Return every shipped cell file that runs in simulated time by itself."""
    files = {path: yaml.safe_load(path.read_text()) for path in sorted(CONFIGS.glob("*.yaml"))}
    return [path for path, data in files.items() if data.get("time") == "simulated" and "scene" in data]


def _prepared(path: Path, folder: Path, *, learned: bool) -> Path:
    data = yaml.safe_load(path.read_text())
    if "collect" in data:
        data["task"]["samples"] = _SAMPLES
    prepared = folder / path.name
    prepared.write_text(yaml.safe_dump(data if learned else on_true_contact(data)))
    return prepared


def _plot(laps: Sequence[Lap], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot([each.cell_s / 3600.0 for each in laps], [each.held.memory_mb for each in laps], linewidth=1)
    axes.set(xlabel="cell time, h", ylabel="resident memory, MB", ylim=(0.0, None))
    axes.set_title(f"{len(laps)} runs, {sum(bool(each.fault) for each in laps)} with a fault", fontsize=9)
    figure.savefig(path, dpi=110)
