"""Cells whose protection is weakened or removed, and whether the test module that was generated before notices.

    python -m benchmarks hil-mutation

``touchcell new hil`` writes a module for each cell. Then one interlock of the cell file is weakened or removed, and the
module runs in simulation: it has to go red. The unchanged cell has to be green in the same tests.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.cli.new_hil import new_hil
from touchcell.paths import CONFIGS


@dataclass(frozen=True, slots=True)
class Mutation:
    """One change to the protection of a cell.

    Attributes:
        cell: a cell file that ships.
        interlock: its name.
        change: keys with other values; None removes it.
    """

    cell: str
    interlock: str
    change: dict[str, Any] | None

    def __str__(self) -> str:
        if self.change is None:
            return "removed"
        return ", ".join(f"{key}: {value}" for key, value in self.change.items())


MUTATIONS = (
    Mutation("surface_follow_sim.yaml", "stale_frame", {"limit_ms": 600}),
    Mutation("surface_follow_dome_sim.yaml", "out_of_range", None),
    Mutation("surface_follow_bench.yaml", "contact_lost", {"limit_ms": 3000}),
    Mutation("object_track_sim.yaml", "tcp_speed", {"limit_m_s": 0.3}),
    Mutation("object_track_panda_sim.yaml", "indentation", {"limit_mm": 12}),
    Mutation("single_push_sim.yaml", "stale_arm", {"limit_ms": 400}),
    Mutation("single_push_bench.yaml", "tilt", {"limit_deg": 85}),
    Mutation("dual_push_bench.yaml", "follower_box", {"max_mm": [700, 230, 440]}),
    Mutation("steps_sim.yaml", "workspace", {"min_mm": [-120, -80, 10]}),
    Mutation("collect_bench.yaml", "exposure", None),
    Mutation("dual_push_sim.yaml", "stale_frame", None),
)
"""One for each of more than ten cells: all kinds of task, of arm and of change."""


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``hil-mutation.json`` and ``hil-mutation.txt`` into ``out``; exit 1 if one survives."""
    parser = argparse.ArgumentParser(prog="hil-mutation", description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="*", help="only these cells")
    options = parser.parse_args(arguments)
    lines = [f"{'cell':<30}{'interlock':<16}{'change':<34}{'as it was':<12}changed"]
    print(lines[0], flush=True)
    rows: list[dict[str, Any]] = []
    for mutation in MUTATIONS:
        if options.cells and mutation.cell not in options.cells:
            continue
        before, after, why = results(mutation)
        lines.append(f"{mutation.cell:<30}{mutation.interlock:<16}{mutation!s:<34}{before:<12}{after}  {why}")
        print(lines[-1], flush=True)
        rows.append({"cell": mutation.cell, "interlock": mutation.interlock, "change": str(mutation)})
        rows[-1] |= {"before": before, "after": after, "why": why}
    caught = sum(row["before"] == "green" and row["after"] == "red" for row in rows)
    lines.append(f"{caught} of {len(rows)} noticed")
    print(lines[-1])
    (out / "hil-mutation.json").write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")
    (out / "hil-mutation.txt").write_text("\n".join(lines) + "\n")
    if caught < len(rows):
        raise SystemExit(1)


def results(mutation: Mutation) -> tuple[str, str, str]:
    """Return how the interlock's generated tests end before and after the change, and what they say then."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Files that a cell names are looked for beside it.
        for each in CONFIGS.iterdir():
            if each.name != mutation.cell and each.is_file():
                (folder / each.name).symlink_to(each)
        cell = folder / mutation.cell
        cell.write_text((CONFIGS / mutation.cell).read_text())
        module = new_hil(cell, folder)
        before, _ = _tests(module, mutation.interlock)
        data = yaml.safe_load(cell.read_text())
        if mutation.change is None:
            del data["interlocks"][mutation.interlock]
        else:
            data["interlocks"][mutation.interlock] |= mutation.change
        cell.write_text(yaml.safe_dump(data))
        after, why = _tests(module, mutation.interlock)
    return before, after, why


def _tests(module: Path, interlock: str) -> tuple[str, str]:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        module.name,
        "-k",
        f"interlock_{interlock}",
    ]
    done = subprocess.run(
        command,
        cwd=module.parent,
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    if done.returncode == 0:
        return "green", ""
    if "InvalidCell" in done.stdout:
        return "red", "the cell file is refused"
    found = re.search(r"^E +(?:AssertionError: |.*?Error: )?(.+)$", done.stdout, re.MULTILINE)
    return "red", found.group(1)[:90] if found else f"exit code {done.returncode}"
