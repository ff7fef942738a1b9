"""``touchcell bench worlds``: one bench cell for each shipped task, run in every world that a desk has.

For each cell and world: how the run ended, how long it took, and the depth that was felt against what was wanted; where
a cell ran in both, how far the tools were apart: the RMS distance while the task was at work, at equal times from its
begin. A lag of ``t`` s at ``v`` mm/s shows as ``v t``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.run_data import Run, load_run
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.recording.mcap import RECORDING
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS

_WORLDS: Final[tuple[WorldName, ...]] = ("sim", "emulated")
_WORK: Final = ("run", "press", "touch")
"""States in which a task is at work, the first that it has."""
_FELT: Final = ("run", "press", "settle")
_COLUMNS: Final = (
    f"{'cell':<24}{'world':<10}{'ended':<9}{'after s':>8}{'depth mm':>10}{'error RMS':>10}{'tools apart mm':>16}"
)


def run(arguments: Sequence[str], out: Path) -> None:
    """Run the cells (all shipped ``*_bench.yaml``, or those named) and print a table; write ``worlds.json``."""
    names = list(arguments) or sorted(path.name for path in CONFIGS.glob("*_bench.yaml"))
    rows: list[dict[str, Any]] = []
    print(_COLUMNS)
    for name in names:
        ways: dict[str, dict[str, Array]] = {}
        for world in _WORLDS:
            row = _run(find_cell(Path(name)), world, ways)
            if len(ways) == len(_WORLDS):
                row["tools_apart_mm"] = apart_mm(ways["sim"], ways["emulated"])
            rows.append(row)
            print(_line(row), flush=True)
    (out / "worlds.json").write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")
    (out / "worlds.txt").write_text("\n".join([_COLUMNS, *map(_line, rows)]) + "\n")


def _run(path: Path, world: WorldName, ways: dict[str, dict[str, Array]]) -> dict[str, Any]:
    row: dict[str, Any] = {"cell": path.stem, "world": world}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [sys.executable, "-m", "touchcell", "run", str(path), "--on", world, "--out", str(folder / "run")]
        if "collect:" in path.read_text():
            command += ["--data", str(folder / "collected")]
        done = subprocess.run([*command, "--quiet"], capture_output=True, text=True, check=False)
        if not (folder / "run" / RECORDING).is_file():
            return {**row, "ended": "refused", "reason": done.stderr.strip().splitlines()[-1]}
        ended = json.loads((folder / "run" / "result.json").read_text())
        recording = load_run(folder / "run" / RECORDING)
    row |= {"ended": ended["outcome"], "reason": ended["reason"], "duration_s": ended.get("duration_s")}
    ways[world] = _ways(recording)
    wanted = _depths(recording)
    if len(wanted):
        row["depth_mm"] = float(np.mean(wanted[:, 0]))
        off = wanted[:, 0] - wanted[:, 1]
        if np.isfinite(off).all():
            row["error_rms_mm"] = float(np.sqrt(np.mean(off**2)))
    return row


def _depths(recording: Run) -> Array:
    """Return (n, 2) the felt depth of the first sensor and the wanted one while the task was at work, mm."""
    sensors, task = recording.roles("sensors", "contact"), recording.series("/task")
    if not sensors or task is None:
        return np.empty((0, 2))
    contact = recording.series(f"/sensors/{sensors[-1]}/contact")
    assert contact is not None
    felt = contact.column("z_mm")
    index = np.clip(np.searchsorted(task.t_s, contact.t_s, side="right") - 1, 0, len(task.t_s) - 1)
    own = task.column(f"{sensors[-1]}_reference_z_mm")
    wanted = (own if np.isfinite(own).any() else task.column("reference_z_mm"))[index]
    at_work = np.zeros(len(felt), dtype=bool)
    for state in _FELT:
        at_work |= recording.during(contact.t_s, state)
    found = np.column_stack([felt, wanted])[at_work & np.isfinite(felt)]
    return found


def _ways(recording: Run) -> dict[str, Array]:
    """Return by arm (n, 4) [t s, x y z mm] of its tool while the task was at work, from its begin."""
    found = {}
    for role in recording.roles("arms", "tcp"):
        tcp = recording.series(f"/arms/{role}/tcp")
        assert tcp is not None
        for state in _WORK:
            inside = recording.during(tcp.t_s, state)
            if inside.any():
                rows = np.column_stack([tcp.t_s, tcp.poses()[:, :3]])[inside]
                rows[:, 0] -= rows[0, 0]
                found[role] = rows
                break
    return found


def apart_mm(one: dict[str, Array], other: dict[str, Array]) -> float | None:
    """Return the RMS distance between the ways of the tools at equal times; None where neither moved."""
    distances = []
    for role in one.keys() & other.keys():
        a, b = one[role], other[role]
        t_s = a[a[:, 0] <= b[-1, 0], 0]
        at = [np.column_stack([np.interp(t_s, way[:, 0], way[:, k]) for k in (1, 2, 3)]) for way in (a, b)]
        distances.append(np.linalg.norm(at[0] - at[1], axis=1))
    return float(np.sqrt(np.mean(np.concatenate(distances) ** 2))) if distances else None


def _line(row: dict[str, Any]) -> str:
    def number(key: str, digits: int) -> str:
        value = row.get(key)
        return "-" if value is None else f"{value:.{digits}f}"

    reason = f"  {row['reason']}" if row.get("reason") else ""
    return (
        f"{row['cell']:<24}{row['world']:<10}{row['ended']:<9}{number('duration_s', 2):>8}"
        f"{number('depth_mm', 2):>10}{number('error_rms_mm', 3):>10}{number('tools_apart_mm', 2):>16}{reason}"
    )
