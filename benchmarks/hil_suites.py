"""Modules of ``touchcell new hil`` for whole cells, as they come, in simulation and on emulators.

    python -m benchmarks hil-suites [CELL ...] [--on sim emulated] [--pace P]

For each cell and world: how many of the module's tests passed, failed and were skipped, how many were repeated at a
slower pace because this machine was late for a control cycle, how long it took, and how many processes wanted to run.
Below the table, why tests were skipped, and which failed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell

_CELLS: Final = ("surface_follow_bench.yaml", "dual_push_bench.yaml", "steps_damiao_bench.yaml")
_COLUMNS: Final = (
    f"{'cell':<24}{'world':<10}{'pace':>5}{'passed':>8}{'failed':>8}{'skipped':>9}"
    f"{'repeated':>10}{'minutes':>9}{'load':>7}"
)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``hil_suites.json`` and ``hil_suites.txt`` into ``out``."""
    parser = argparse.ArgumentParser("python -m benchmarks hil-suites", description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="*", default=_CELLS, help="cell files (default: three bench cells)")
    parser.add_argument("--on", nargs="+", choices=("sim", "emulated"), default=("sim", "emulated"), help="worlds")
    parser.add_argument("--pace", type=float, default=1.0, help="emulated seconds in each second of this machine")
    options = parser.parse_args(arguments)
    lines, rows = [_COLUMNS], []
    print(_COLUMNS, flush=True)
    for name in options.cells:
        for world in options.on:
            row = _suite(find_cell(Path(name)), world, options.pace)
            rows.append(row)
            lines.append(_line(row))
            print(lines[-1], flush=True)
    for row in rows:
        told = [f"{count} skipped: {reason}" for reason, count in row["reasons"].items()]
        told += [f"failed: {failed}" for failed in row["names"]]
        lines += [f"{row['cell']}, {row['world']}", *(f"  {each}" for each in told)]
    print("\n".join(lines[len(rows) + 1 :]))
    (out / "hil_suites.json").write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")
    (out / "hil_suites.txt").write_text("\n".join(lines) + "\n")


def _suite(cell: Path, world: str, pace: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = [sys.executable, "-m", "touchcell", "new", "hil", str(cell), "--out", str(folder)]
        subprocess.run(made, check=True, capture_output=True)
        (module,) = folder.glob("test_*.py")
        junit = folder / "junit.xml"
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", module.name, f"--junitxml={junit}"]
        command += ["--on", world, *(("--pace", str(pace)) if world == "emulated" else ())]
        began_s, loads = time.monotonic(), [os.getloadavg()[0]]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        minutes = (time.monotonic() - began_s) / 60.0
        loads.append(os.getloadavg()[0])
        cases = list(ET.parse(junit).getroot().iter("testcase"))
    skipped = [found.get("message", "") for case in cases if (found := case.find("skipped")) is not None]
    failed = [
        f"{case.get('name')}: {(found.get('message') or '').partition(chr(10))[0]}"
        for case in cases
        for found in (case.find("failure"), case.find("error"))
        if found is not None
    ]
    return {
        "cell": cell.stem,
        "world": world,
        "pace": pace if world == "emulated" else None,
        "passed": len(cases) - len(skipped) - len(failed),
        "failed": len(failed),
        "skipped": len(skipped),
        "repeated": done.stdout.count(": repeated at a pace of "),
        "minutes": minutes,
        "load": max(loads),
        "reasons": dict(Counter(skipped).most_common()),
        "names": failed,
    }


def _line(row: dict[str, Any]) -> str:
    pace = "-" if row["pace"] is None else f"{row['pace']:g}"
    return (
        f"{row['cell']:<24}{row['world']:<10}{pace:>5}{row['passed']:>8}{row['failed']:>8}{row['skipped']:>9}"
        f"{row['repeated']:>10}{row['minutes']:>9.1f}{row['load']:>7.1f}"
    )
