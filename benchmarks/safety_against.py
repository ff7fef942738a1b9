"""Cost of safety per control cycle beside that of an earlier checkout, measured in one alternating run.

    python -m benchmarks safety-against CHECKOUT [--rounds N]

Each round starts one process in either checkout, with its own environment (``.venv``), one after the other; of each
item the quickest round counts (of rows "of it", which are differences, the median), so that other load of the machine
matters less. The first line of the table that is compared is the whole review of a cell: that of the earlier checkout
against that of this one with the rules that are always on, which the earlier one did not have.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from touchcell.cell.bench.provenance import provenance
from touchcell.paths import CHECKOUT

_MODULES = ("tests.fault_injection.safety_cost", "benchmarks.safety_cost")
_CHILD = """
import importlib, importlib.util, json
for name in {modules!r}:
    try:
        found = importlib.import_module(name)
    except ModuleNotFoundError:
        continue
    print(json.dumps(found.costs()))
    break
"""
_WHOLE = "review: one arm and sensor, 16 interlocks"
_ALWAYS = f"{_WHOLE} and those always on"


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``safety_against.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="safety-against", description=__doc__)
    parser.add_argument("checkout", type=Path, help="the earlier one, with a .venv of its own")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)
    then: list[dict[str, float]] = []
    now: list[dict[str, float]] = []
    for _ in range(options.rounds):
        then.append(_costs(options.checkout, options.checkout.absolute() / ".venv" / "bin" / "python"))
        now.append(_costs(CHECKOUT, Path(sys.executable)))
    quickest_then, quickest_now = _quickest(then), _quickest(now)
    print(f"{'microseconds of CPU per cycle':<66}{'then':>8}{'now':>8}{'ratio':>7}")
    _print_row("review of object_track_sim with the rules always on", quickest_then[_WHOLE], quickest_now[_ALWAYS])
    for item in dict.fromkeys([*quickest_then, *quickest_now]):
        _print_row(item, quickest_then.get(item), quickest_now.get(item))
    report = {**provenance(), "rounds": options.rounds, "then": quickest_then, "now": quickest_now}
    (out / "safety_against.json").write_text(json.dumps(report, indent=1) + "\n")


def _costs(checkout: Path, python: Path) -> dict[str, float]:
    environment = {**os.environ, "PYTHONPATH": str(checkout.absolute()), "OMP_NUM_THREADS": "1"}
    command = [str(python), "-c", _CHILD.format(modules=_MODULES)]
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=True)
    costs: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return costs


def _quickest(rounds: Sequence[dict[str, float]]) -> dict[str, float]:
    # The quickest of differences would be that of the round whose other term was slowest.
    return {
        item: (statistics.median if item.startswith(" ") else min)(each[item] for each in rounds) for item in rounds[0]
    }


def _print_row(item: str, then: float | None, now: float | None) -> None:
    ratio = f"{now / then:7.2f}" if then and now is not None else f"{'':>7}"
    print(f"{item:<66}{_number(then)}{_number(now)}{ratio}")


def _number(value: float | None) -> str:
    return f"{'-':>8}" if value is None else f"{value:8.1f}"
