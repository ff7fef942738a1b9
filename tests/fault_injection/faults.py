"""``touchcell bench faults``: every fault of every emulated device in every state of every task, and the reaction.

It runs in real time. Results are stored in ``faults.part.jsonl`` after each case, so that a run that was interrupted,
or starved of some cases by a busy machine, continues where it ended.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from tests.fault_injection.emulated_matrix import (
    ARMS,
    CAMERAS,
    DEVICES,
    LEFT_OUT,
    RULES,
    EmulatedCase,
    Place,
    faults_of,
    places,
)
from tests.fault_injection.fault_matrix import median_and_worst
from touchcell.cell.bench.provenance import provenance

PART: Final = "faults.part.jsonl"
_ADDRESS: Final = 500_000
_ADDRESSES: Final = 100_000


class _Worker:
    """One ``tests.fault_injection.emulated_worker``, restarted when it has died."""

    def __init__(self, address: int, log: Path) -> None:
        self._address = address
        self._log = log
        self._process: subprocess.Popen[str] | None = None

    def run(self, place: Place) -> EmulatedCase:
        """Run one case; the death of the process is a result too."""
        if self._process is None:
            self._process = self._start()
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(asdict(place)) + "\n")
        process.stdin.flush()
        if line := process.stdout.readline():
            return _case(json.loads(line))
        self.close()
        return EmulatedCase(place, "", problem=f"the process of the cell died with code {process.returncode}")

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.communicate()
            self._process = None

    def _start(self) -> subprocess.Popen[str]:
        with self._log.open("a") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "tests.fault_injection.emulated_worker", str(self._address)],
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``faults.json`` into ``out``. Takes about two seconds per case."""
    parser = argparse.ArgumentParser(prog="touchcell bench faults", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "names", nargs="*", metavar="driver", help=f"of {', '.join((*ARMS, *CAMERAS, *DEVICES))}; default: all"
    )
    parser.add_argument("--state", action="append", help="only in this state of the tasks")
    parser.add_argument("--task", action="append", help="only in this task")
    parser.add_argument("--all", action="store_true", help="also cases that are equivalent to another by rule")
    parser.add_argument("--jobs", type=int, default=2, help="cases in parallel")
    parser.add_argument("--again", action="store_true", help="discard the results of an interrupted run")
    options = parser.parse_args(arguments)
    part = out / PART
    if options.again:
        part.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="touchcell-faults-") as folder:
        everything = [
            (place, rule)
            for driver in options.names or (*ARMS, *CAMERAS, *DEVICES)
            for place, rule in places(driver, Path(folder))
            if (options.state is None or place.state in options.state)
            and (options.task is None or place.task in options.task)
        ]
        faults = {driver: faults_of(driver, Path(folder)) for driver in dict.fromkeys(p.driver for p, _ in everything)}
        # Cases in which the machine was too busy for the fault are repeated.
        found = {case.place: case for case in _kept(part) if case.reached}
        wanted = [place for place, rule in everything if options.all or not rule]
        missing = [place for place in wanted if place not in found]
        for case in _run_all(missing, options.jobs, part, Path(folder)):
            found[case.place] = case
    cases = [found[place] for place in wanted if place in found]
    _print_table(cases, faults)
    tried = set(wanted)
    same = Counter(rule for place, rule in everything if rule and place not in tried)
    _print_coverage(cases, len(wanted), len(everything), same)
    report = {**provenance(), "places": len(everything), "same": same, "cases": [asdict(case) for case in cases]}
    (out / "faults.json").write_text(json.dumps(report, indent=1) + "\n")
    if len(cases) == len(wanted) and all(case.reached for case in cases):
        part.unlink(missing_ok=True)


def _run_all(missing: Sequence[Place], jobs: int, part: Path, folder: Path) -> Iterator[EmulatedCase]:
    """Yield results as they arrive; ends early on Ctrl-C."""
    with _workers(jobs, folder) as workers, ThreadPoolExecutor(jobs) as pool, part.open("a") as kept:

        def run_one(place: Place) -> EmulatedCase:
            worker = workers.get()
            try:
                return worker.run(place)
            finally:
                workers.put(worker)

        waiting = [pool.submit(run_one, place) for place in missing]
        try:
            for number, future in enumerate(as_completed(waiting), start=1):
                case = future.result()
                kept.write(json.dumps(asdict(case)) + "\n")
                kept.flush()
                print(f"\r{number} of {len(missing)}: {case.place}".ljust(110), end="", file=sys.stderr, flush=True)
                yield case
        except KeyboardInterrupt:
            print("\ninterrupted: results of the cases so far; the same command continues", file=sys.stderr)
            pool.shutdown(wait=False, cancel_futures=True)
    print(file=sys.stderr)


@contextmanager
def _workers(jobs: int, folder: Path) -> Iterator[SimpleQueue[_Worker]]:
    made = [_Worker(_ADDRESS + k * _ADDRESSES, folder / f"worker{k}.log") for k in range(jobs)]
    queue: SimpleQueue[_Worker] = SimpleQueue()
    for worker in made:
        queue.put(worker)
    try:
        yield queue
    finally:
        for worker in made:
            worker.close()


def _kept(part: Path) -> Iterator[EmulatedCase]:
    if part.exists():
        for line in part.read_text().splitlines():
            yield _case(json.loads(line))


def _case(data: dict[str, Any]) -> EmulatedCase:
    return EmulatedCase(**{**data, "place": Place(**data["place"])})


def _print_table(cases: Sequence[EmulatedCase], faults: Mapping[str, Mapping[str, tuple[Any, str]]]) -> None:
    print(f"{'':<43}{'places':>7}{'fault to end, ms':>17}{'then at rest, ms':>17}{'way, mm':>14}")
    print(
        f"{'driver, fault, reaction':<43}{'':>7}"
        + f"{'median':>10}{'worst':>7}" * 2
        + f"{'median':>8}{'worst':>6}  ended by"
    )
    for driver, of_driver in faults.items():
        for fault, (_, answer) in of_driver.items():
            these = [case for case in cases if (case.place.driver, case.place.fault) == (driver, fault)]
            if these:
                print(_row(f"{driver}, {fault}, {answer}", these))


def _row(name: str, cases: Sequence[EmulatedCase]) -> str:
    detection = median_and_worst([1e3 * c.detection_s for c in cases if c.detection_s is not None], 10, 7, 0)
    rest = median_and_worst([1e3 * c.rest_s for c in cases if c.rest_s is not None], 10, 7, 0)
    way = median_and_worst([1e3 * c.distance_m for c in cases if c.distance_m is not None], 8, 6, 1)
    return f"{name:<43}{len(cases):>7}{detection}{rest}{way}  {', '.join(sorted({c.ended_by or '-' for c in cases}))}"


def _print_coverage(cases: Sequence[EmulatedCase], wanted: int, everything: int, same: Mapping[str, int]) -> None:
    bad = [case for case in cases if case.problem]
    print(f"\nas expected: {len(cases) - len(bad)} of {len(cases)} places tried, {wanted} to be tried")
    for case in bad:
        print(f"  {case.place}: {case.problem}")
    print(f"equivalent by construction: {sum(same.values())} of all {everything} places (--all tries them)")
    for rule in RULES:
        print(f"  {same[rule]:>4}: {rule}")
    print("not part of the matrix:")
    for reason in LEFT_OUT:
        print(f"        {reason}")
