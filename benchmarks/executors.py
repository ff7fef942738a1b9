"""``python -m benchmarks executors``: what an executor adds to each trial, and whether an interruption loses any.

``no-op`` is the time for each of many pieces of work that do nothing, without the start of the workers; ``same``
compares the numbers and recordings of every executor with those of this process, bit for bit; ``sweep`` is the cost of
a real sweep over the CPU time of its trials, beside an earlier checkout; ``killed`` ends the command of a sweep by
SIGKILL at random moments and counts trials that were lost, or run twice after they had finished; ``mixed`` is a sweep
of 64 trials of which one raises, one is killed and one hangs; ``apart`` compares the recordings of a sweep on dask
workers in network namespaces of their own, which do not see the sweep's folder, with those of this machine.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.other_load import Usage, cpu_s_of
from benchmarks.separate_workers import separate_workers
from benchmarks.sweep_cost import sweep_costs
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.experiments.executors import EXECUTORS, Workers
from touchcell.cell.experiments.remote_work import send_by_value
from touchcell.cell.recording.compare import compare_recordings
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.sweeps.factors import make_factors
from touchcell.cell.sweeps.measures import run_measures
from touchcell.cell.sweeps.sweep import Sweep, run_sweep
from touchcell.errors import TouchcellError
from touchcell.paths import CONFIGS

MODULES = {"local": "pebble", "dask": "distributed", "ray": "ray", "slurm:local": "submitit"}
SHORT = {"sensors.sensor.estimator": {"kind": "true_contact"}, "task.distance_mm": 10}


def nothing(item: int) -> int:
    """Return ``item``."""
    return item


def no_op(executor: str, items: int, jobs: int) -> dict[str, float]:
    """Return the time until the first result, and for each of the others wall-clock and CPU time, of all processes."""
    name, _, address = executor.partition(":")
    send_by_value(nothing)
    started = time.perf_counter()
    first = ended = None
    for number, _ in enumerate(EXECUTORS.load(name).run(nothing, range(items), Workers(jobs, 3600.0, None, address))):
        first = Usage.now() if first is None else first
        if number == items - 1:
            ended = Usage.now()
    assert first is not None
    assert ended is not None
    used, each = ended - first, 1e3 / max(items - 1, 1)
    return {
        "items": items,
        "start_s": first.wall_s - started,
        "each_ms": each * used.wall_s,
        "each_cpu_ms": each * used.ours_s,
        "others_cores": used.others_cores,
    }


def sweep_command(folder: Path, trials: int, jobs: int) -> list[str]:
    """Return the command of a sweep of ``trials`` short runs."""
    settings = [part for key, value in SHORT.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    command = [sys.executable, "-m", "touchcell", "sweep", "surface_follow_sim.yaml", *settings]
    return [*command, "--sample", f"seed=1..{trials}", "--jobs", str(jobs), "--out", str(folder)]


def same(executors: Sequence[str], trials: int, jobs: int) -> dict[str, dict[str, int]]:
    """Return how many trials of each executor have the numbers and the recordings of this process, bit for bit."""
    factors = make_factors({}, {"seed": f"1..{trials}"}, samples=None)
    sweep = Sweep(CONFIGS / "surface_follow_sim.yaml", factors, settings=SHORT)
    found: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory() as name:
        here = run_sweep(sweep, Path(name) / "here").finished
        for executor in executors:
            there = run_sweep(sweep, Path(name) / executor, workers=Workers(jobs, 3600.0), executor=executor).finished
            pairs = list(zip(here, there, strict=True))
            found[executor] = {
                "trials": trials,
                "numbers": sum(each.done and each.measures == other.measures for each, other in pairs),
                "recordings": sum(_same_recordings(each.folder.path, other.folder.path) for each, other in pairs),
            }
    return found


def _same_recordings(first: Path, second: Path) -> bool:
    try:
        return all(topic.identical for topic in compare_recordings(first / RECORDING, second / RECORDING))
    except TouchcellError:
        return False


def killed(times: int, trials: int, jobs: int, seed: int) -> dict[str, int]:
    """Kill the command of a sweep ``times`` times; return how many finished trials were lost or run twice."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known: dict[str, int] = {}
        lost = repeated = 0
        for attempt in range(times + 1):
            process = subprocess.Popen(
                sweep_command(folder, trials, jobs), stdout=subprocess.DEVNULL, start_new_session=True
            )
            if attempt < times:
                # A moment by the work done: on a busy machine seconds pass before the first trial begins.
                at_s = rng.uniform(1.0, 8.0)
                while process.poll() is None and cpu_s_of(process.pid) < at_s:
                    time.sleep(0.05)
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            now = {
                path.parent.name: path.stat().st_mtime_ns
                for path in folder.glob("trials/*/trial.json")
                if json.loads(path.read_text())["outcome"] == "done"
            }
            lost += len(set(known) - set(now))
            repeated += sum(now[trial] != stamp for trial, stamp in known.items() if trial in now)
            known = now
    return {"kills": times, "trials": trials, "finished": len(known), "lost": lost, "repeated": repeated}


def measure_or_break(folder: RunFolder) -> Mapping[str, float]:
    """Return the numbers of a trial; number 13 raises, 29 is killed, 47 hangs."""
    number = int(folder.path.name)
    if number == 13:
        raise RuntimeError("trial 13 raises")
    if number == 29:
        os.kill(os.getpid(), signal.SIGKILL)
    while number == 47:
        time.sleep(1.0)
    return run_measures(folder)


def mixed(trials: int, jobs: int, limit_s: float) -> dict[str, Any]:
    """Return the outcomes of a sweep in which three trials break, and the reasons of these three."""
    factors = make_factors({}, {"seed": f"1..{trials}"}, samples=None)
    sweep = Sweep(CONFIGS / "surface_follow_sim.yaml", factors, measure=measure_or_break, settings=SHORT)
    with tempfile.TemporaryDirectory() as name:
        found = run_sweep(sweep, Path(name), workers=Workers(jobs, limit_s, None, ""))
    return {
        "outcomes": dict(Counter(each.outcome for each in found.finished)),
        "broken": {each.trial.name: each.reason for each in found.finished if each.broken},
    }


def apart(trials: int) -> dict[str, int]:
    """Return how many recordings of workers that share nothing equal those of this machine, message by message."""
    with tempfile.TemporaryDirectory() as name:
        here, there = Path(name) / "here", Path(name) / "hidden" / "there"
        there.mkdir(parents=True)
        subprocess.run(sweep_command(here, trials, 1), check=True, stdout=subprocess.DEVNULL)
        with separate_workers(there.parent, Path(name) / "workers") as address:
            command = [*sweep_command(there, trials, 2), "--executor", f"dask:{address}"]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        folders = sorted(path.name for path in (here / "trials").iterdir())
        equal = sum(_same_recordings(here / "trials" / each, there / "trials" / each) for each in folders)
    return {"trials": trials, "workers": 2, "same": equal}


def run(arguments: list[str], out: Path) -> None:
    """Print the tables, and leave them in ``out/executors.txt`` and ``.json``."""
    parser = argparse.ArgumentParser("executors", description=__doc__)
    parser.add_argument("--items", type=int, default=1000, help="pieces of work that do nothing")
    parser.add_argument("--trials", type=int, default=40, help="short ones, of the sweep that is killed")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--limit-s", type=float, default=60.0, help="time limit of each trial of ``mixed``")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--rounds", type=int, default=2, help="of the real sweep")
    parser.add_argument("--real-trials", type=int, default=8, help="of the real sweep in each round")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="an earlier one, with a .venv of its own")
    options = parser.parse_args(arguments)
    installed = [each for each, module in MODULES.items() if importlib.util.find_spec(module) is not None]
    missing = [f"{each}: {module} is not installed" for each, module in MODULES.items() if each not in installed]
    found: dict[str, Any] = {**provenance(), "load": os.getloadavg(), "no_op": {}}
    lines: list[str] = []

    def show(line: str) -> None:
        lines.append(line)
        print(line, flush=True)

    show(f"{found['date']}, commit {found['commit']}, {found['cores']} cores, load {found['load'][0]:.1f}")
    show(
        "\n".join(
            [
                f"{'executor':12} {'items':>6} {'start s':>8} {'ms each':>8} {'CPU ms each':>12} {'others, cores':>13}",
                *missing,
            ]
        )
    )
    for executor in installed:
        # Each Slurm job is a process with an interpreter of its own.
        items = min(options.items, 10) if executor == "slurm:local" else options.items
        cost = found["no_op"][executor] = no_op(executor, items, options.jobs)
        show(
            f"{executor:12} {items:6} {cost['start_s']:8.2f} {cost['each_ms']:8.2f} {cost['each_cpu_ms']:12.2f} "
            f"{cost['others_cores']:13.2f}"
        )
    found["same"] = same(installed, 4, options.jobs)
    for executor, equal in found["same"].items():
        show(
            f"same: {executor}: numbers of {equal['numbers']}, recordings of {equal['recordings']} of {equal['trials']}"
        )
    found["sweep"] = sweep_costs(options.against, options.real_trials, options.jobs, options.rounds)
    columns = ("wall_s", "cpu_s", "trials_cpu_s", "others_cores", "cpu_ratio", "left_ratio", "wall_ratio")
    show(f"{'sweep':8} {'trials':>6} " + " ".join(f"{name:>12}" for name in columns))
    for name, costs in found["sweep"].items():
        for cost in costs:
            show(f"{name:8} {cost['trials']:6} " + " ".join(f"{cost[column]:12.3f}" for column in columns))
    found["killed"] = killed(options.kills, options.trials, options.jobs, seed=1)
    show("killed: " + ", ".join(f"{name} {value}" for name, value in found["killed"].items()))
    found["mixed"] = mixed(64, options.jobs, options.limit_s)
    show("mixed: " + ", ".join(f"{count} {outcome}" for outcome, count in found["mixed"]["outcomes"].items()))
    for trial, reason in found["mixed"]["broken"].items():
        show(f"  {trial}: {reason}")
    if os.geteuid() == 0:
        found["apart"] = apart(4)
        show("apart: " + ", ".join(f"{name} {value}" for name, value in found["apart"].items()))
    (out / "executors.txt").write_text("\n".join(lines) + "\n")
    (out / "executors.json").write_text(json.dumps(found, indent=1) + "\n")
