"""The same faults, by name, in simulation and on emulators: whether both end in the same way.

    python -m benchmarks world-faults [--pace 0.2] [CELL ...]

A fault of each device is injected while the task works. For each world: what tripped first, after how long, and how
long each arm truly moved afterwards against what its stop declares, by the ground truth of simulation and emulators. A
run that ends before its fault, as on a machine that has no time for it, is repeated and counted.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.testing.cell_under_test import CellUnderTest
from touchcell.testing.emulation.world import running_emulators

CELLS = {"surface_follow_bench.yaml": "run", "single_push_bench.yaml": "run"}
FAULTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("sensor", {"frozen": True}),
    ("sensor", {"last_seq": 0}),
    ("sensor", {"extra_latency_s": 0.5}),
    ("sensor", {"gain": 1.6}),
    ("arm", {"stale": True}),
    ("arm", {"nan_state": True}),
)
_MOST_REPEATS = 4
_WORLDS = ("sim", "emulated")


@dataclass(frozen=True, slots=True)
class End:
    """How a cell ended after a fault.

    Attributes:
        first_cause: name of the interlock that tripped first; empty if none did.
        after_s: from the fault to the trip.
        moved_s: how long an arm truly moved after the trip, the longest.
        declared_s: what its stop declares.
    """

    first_cause: str
    after_s: float
    moved_s: float
    declared_s: float


class _Disturbed(Exception):
    """The cell ended before its fault."""


def end_of(cell: str, world: str, device: str, faults: dict[str, Any], state: str, pace: float) -> End:
    """Return how a cell ends in a world after faults of one device."""
    settings: dict[str, Any] = {"on_trip": "wait_for_reset"}
    with ExitStack() as stack:
        if world == "sim":
            running = stack.enter_context(CellUnderTest(cell, on="sim", set=settings))
        else:
            settings["emulated_pace"] = pace
            emulated = stack.enter_context(running_emulators(find_cell(Path(cell)), settings=settings))
            running = stack.enter_context(CellUnderTest(emulated.plan, emulated=emulated))
        try:
            running.run_until(state)
        except AssertionError as error:
            raise _Disturbed(str(error)) from None
        running.run_for(0.5)
        if running.first_cause is not None or running.has_ended:
            raise _Disturbed(str(running.first_cause))
        if "last_seq" in faults:
            source = next(iter(running.cell.sensors.values())).frame
            faults = {"last_seq": 0 if source is None else source.seq}
        began_s = running.t_s
        running.inject(device, **faults)
        try:
            cause = running.run_until_trip(limit_s=3.0)
        except AssertionError as error:
            return End(f"none: {error}", float("nan"), float("nan"), float("nan"))
        after_s = 1e-9 * (cause.t_ns - running.cell.start_ns) - began_s
        declared_s = max(report.declared_s for report in running.stops.values())
        return End(cause.interlock, after_s, max(running.true_stop_s().values()), declared_s)


def _undisturbed(
    cell: str, world: str, device: str, faults: dict[str, Any], state: str, pace: float
) -> tuple[End, int]:
    """Return the first end that came of the fault, and how many runs ended before it."""
    for disturbed in range(_MOST_REPEATS):
        try:
            return end_of(cell, world, device, dict(faults), state, pace), disturbed
        except _Disturbed as error:
            print(f"  again: {error}", file=sys.stderr)
    return End("none: disturbed", float("nan"), float("nan"), float("nan")), _MOST_REPEATS


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``world-faults.json`` and ``world-faults.txt`` into ``out``."""
    parser = argparse.ArgumentParser(prog="world-faults", description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="*", default=list(CELLS))
    parser.add_argument("--pace", type=float, default=1.0, help="emulated seconds in each second of this machine")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    lines = [
        f"{'cell':<22}{'fault':<28}{'world':<10}{'first cause':<16}{'after ms':>9}{'moved ms':>10}{'declared':>9}  same"
    ]
    print(lines[0], flush=True)
    repeats = 0
    for cell in options.cells:
        for device, faults in FAULTS:
            state = CELLS.get(cell, "run")
            found = [_undisturbed(cell, world, device, faults, state, options.pace) for world in _WORLDS]
            ends = [end for end, _ in found]
            repeats += sum(disturbed for _, disturbed in found)
            same = ends[0].first_cause == ends[1].first_cause and all(
                end.moved_s <= end.declared_s + 0.02 for end in ends
            )
            for world, end in zip(_WORLDS, ends, strict=True):
                what = f"{device} " + " ".join(f"{key}" for key in faults)
                lines.append(
                    f"{Path(cell).stem:<22}{what:<28}{world:<10}{end.first_cause:<16}{1e3 * end.after_s:>9.0f}"
                    f"{1e3 * end.moved_s:>10.0f}{1e3 * end.declared_s:>9.0f}  {'yes' if same else 'NO'}"
                )
                print(lines[-1], flush=True)
                about = {"cell": cell, "device": device, "faults": faults, "world": world, "same": same}
                rows.append(about | asdict(end))
    lines.append(f"{repeats} runs ended before their fault and were repeated")
    print(lines[-1])
    report = {**provenance(), "emulated_pace": options.pace, "repeats": repeats, "rows": rows}
    (out / "world-faults.json").write_text(json.dumps(report, indent=1) + "\n")
    (out / "world-faults.txt").write_text("\n".join(lines) + "\n")
