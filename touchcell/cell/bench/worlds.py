"""``touchcell bench worlds``: one bench cell for each shipped task, and one that is jogged, in every world of a desk.

For each cell and world: how the run ended, how long it took, the depth that was felt against what was wanted, the
median time from exposure to command, and the share of control cycles that came late. Where a cell ran in both worlds,
how far apart the tools were while the task was at work: RMS at equal times from the begin of each visit to that state,
the time shift of the emulated motion that brings them closest, and RMS after it. A lag of ``t`` s at ``v`` mm/s shows
as ``v t``. In the row of the simulated run the same figures compare it with one of another seed, that is with other
noise in its images: what two runs of one world are apart. For the bench the file is checked, and nothing is connected.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.analysis.run_data import Run, load_run
from touchcell.cell.bench.jogged import jog_run
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_in_world
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.recording.mcap import RECORDING
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS

_OTHER_SEED: Final = 1000
_JOG: Final = "jog"
_JOGGED: Final = "surface_follow_bench.yaml"
"""The cell that a scripted operator moves by hand."""
_WORK: Final = ("run", "press", "touch", "moving")
"""States in which a task is at work, the first that it has."""
_FELT: Final = ("run", "press", "settle")
_LATE_PERIODS: Final = 1.5
_SHIFTS_S: Final = np.arange(-0.2, 0.2001, 0.005)
_COLUMNS: Final = (
    f"{'cell':<24}{'world':<10}{'ended':<9}{'after s':>8}{'depth mm':>10}{'error RMS':>10}{'latency ms':>11}"
    f"{'late %':>7}{'apart mm':>10}{'shift ms':>9}{'then mm':>8}"
)


Ways: TypeAlias = Mapping[str, Sequence[Array]]


@dataclass(frozen=True, slots=True)
class Apart:
    """How far the tools of two runs were apart.

    Attributes:
        rms_mm: at equal times.
        shift_s: by which the second comes later than the first.
        shifted_rms_mm: at equal times once that is taken out.
    """

    rms_mm: float
    shift_s: float
    shifted_rms_mm: float


def run(arguments: Sequence[str], out: Path) -> None:
    """Run the cells and print a table; write ``worlds.json`` and ``worlds.txt`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench worlds", description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="*", help=f"bench cells, or {_JOG} (default: all that ship, and {_JOG})")
    parser.add_argument("--pace", type=float, default=1.0, help="emulated seconds in each second of this machine")
    options = parser.parse_args(arguments)
    names = options.cells or [*sorted(path.name for path in CONFIGS.glob("*_bench.yaml")), _JOG]
    rows: list[dict[str, Any]] = []
    head = f"emulated at {options.pace:g} of this machine's time"
    print(f"{head}\n{_COLUMNS}", flush=True)
    for name in names:
        path = find_cell(Path(_JOGGED if name == _JOG else name))
        run_cell, title = (_jog, f"jog ({path.stem.removesuffix('_bench')})") if name == _JOG else (_run, path.stem)
        row, simulated = run_cell(path, "sim")
        rows.append({"cell": title, **row, **_apart(simulated, run_cell(path, "sim", f"seed={_OTHER_SEED}")[1])})
        print(_line(rows[-1]), flush=True)
        row, emulated = run_cell(path, "emulated", f"emulated_pace={options.pace}")
        rows.append({"cell": title, **row, **_apart(simulated, emulated)})
        print(_line(rows[-1]), flush=True)
        rows.append({"cell": title, "world": "bench", **_checked(path)})
        print(_line(rows[-1]), flush=True)
    report = {**provenance(), "emulated_pace": options.pace, "rows": rows}
    (out / "worlds.json").write_text(json.dumps(report, indent=1) + "\n")
    (out / "worlds.txt").write_text("\n".join([head, _COLUMNS, *map(_line, rows)]) + "\n")


def _checked(path: Path) -> dict[str, str]:
    try:
        plan_in_world(path, "bench")
    except ConfigError as error:
        return {"ended": "refused", "reason": str(error)}
    return {"ended": "checked", "reason": "no devices here"}


def _apart(one: Run | None, other: Run | None) -> dict[str, float]:
    found = None if one is None or other is None else apart(_ways(one), _ways(other))
    if found is None:
        return {}
    return {"apart_mm": found.rms_mm, "shift_s": found.shift_s, "shifted_mm": found.shifted_rms_mm}


def _run(path: Path, world: WorldName, *settings: str) -> tuple[dict[str, Any], Run | None]:
    """Run a cell; return its row and its recording, None if it was refused."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [sys.executable, "-m", "touchcell", "run", str(path), "--on", world, "--out", str(folder / "run")]
        command += [part for setting in settings for part in ("--set", setting)]
        if "collect:" in path.read_text():
            command += ["--data", str(folder / "collected")]
        done = subprocess.run([*command, "--quiet"], capture_output=True, text=True, check=False)
        if not (folder / "run" / RECORDING).is_file():
            return {"world": world, "ended": "refused", "reason": done.stderr.strip().splitlines()[-1]}, None
        ended = json.loads((folder / "run" / "result.json").read_text())
        recording = load_run(folder / "run" / RECORDING)
    row = {"world": world, "ended": ended["outcome"], "reason": ended["reason"], "duration_s": ended.get("duration_s")}
    return {**row, **_measured(recording)}, recording


def _jog(path: Path, world: WorldName, *settings: str) -> tuple[dict[str, Any], Run | None]:
    """Jog a cell by the script; return its row and its recording."""
    with tempfile.TemporaryDirectory() as name:
        result = jog_run(path, world, Path(name), settings)
        recording = load_run(Path(name) / RECORDING)
    row = {
        "world": world,
        "ended": result.outcome.value,
        "reason": result.reason,
        "duration_s": result.duration_s,
    }
    return {**row, **_measured(recording)}, recording


def _measured(recording: Run) -> dict[str, Any]:
    row: dict[str, Any] = {"latency_ms": _latency_ms(recording), "late_percent": _late_percent(recording)}
    wanted = _depths(recording)
    if len(wanted):
        row["depth_mm"] = float(np.mean(wanted[:, 0]))
        off = wanted[:, 0] - wanted[:, 1]
        if np.isfinite(off).all():
            row["error_rms_mm"] = float(np.sqrt(np.mean(off**2)))
    return row


def _latency_ms(recording: Run) -> float | None:
    """Return the median time from the exposure of a frame to a command that used it; None without such commands."""
    found = []
    for role in recording.roles("arms", "command"):
        series = recording.series(f"/arms/{role}/command")
        if series is not None and any("sensor_to_command_ms" in row for row in series.rows):
            found.append(series.column("sensor_to_command_ms"))
    return float(np.nanmedian(np.concatenate(found))) if found else None


def _late_percent(recording: Run) -> float | None:
    timing = recording.series("/timing")
    if timing is None or len(timing.t_s) < 2:
        return None
    steps = np.diff(timing.t_s)
    return float(100.0 * np.mean(steps > _LATE_PERIODS * np.median(steps)))


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


def _ways(recording: Run) -> Ways:
    """Return by arm the ways of its tool in each of the task's visits to the state in which it is at work."""
    found = {}
    for role in recording.roles("arms", "tcp"):
        tcp = recording.series(f"/arms/{role}/tcp")
        assert tcp is not None
        rows = np.column_stack([tcp.t_s, tcp.poses()[:, :3]])
        for state in _WORK:
            if visits := visits_to(rows, recording.during(tcp.t_s, state)):
                found[role] = visits
                break
    return found


def visits_to(rows: Array, inside: NDArray[np.bool_]) -> list[Array]:
    """Return each stretch of consecutive rows (n, 4) [t s, x y z mm] that are ``inside`` (n,), from its own begin on.

    A task may come back to a state, later in one world than in the other.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8)))
    visits = [rows[first:last].copy() for first, last in edges.reshape(-1, 2)]
    for visit in visits:
        visit[:, 0] -= visit[0, 0]
    return visits


def apart(one: Ways, other: Ways) -> Apart | None:
    """Return how far the ways of the tools were apart, visit by visit; None where no tool moved in both.

    Args:
        one, other: by arm its visits, (n, 4) [t s, x y z mm] each.
    """
    pairs = [pair for role in one.keys() & other.keys() for pair in zip(one[role], other[role], strict=False)]
    pairs = [(a, b) for a, b in pairs if min(a[-1, 0], b[-1, 0]) > 2.0 * _SHIFTS_S[-1]]
    if not pairs:
        return None
    found = [_rms_mm(pairs, shift_s) for shift_s in _SHIFTS_S]
    best = int(np.argmin(found))
    return Apart(_rms_mm(pairs, 0.0), float(_SHIFTS_S[best]), found[best])


def _rms_mm(ways: Sequence[tuple[Array, Array]], shift_s: float) -> float:
    """Return the RMS distance between pairs of ways, the second of each taken ``shift_s`` later."""
    squares = []
    for a, b in ways:
        margin_s = float(_SHIFTS_S[-1])
        within = (a[:, 0] >= margin_s) & (a[:, 0] <= min(a[-1, 0], b[-1, 0]) - margin_s)
        t_s = a[within, 0]
        other = np.column_stack([np.interp(t_s + shift_s, b[:, 0], b[:, k]) for k in (1, 2, 3)])
        squares.append(np.sum((a[within, 1:] - other) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _line(row: dict[str, Any]) -> str:
    def number(key: str, digits: int, scale: float = 1.0) -> str:
        value = row.get(key)
        return "-" if value is None else f"{scale * value:.{digits}f}"

    reason = f"  {row['reason']}" if row.get("reason") else ""
    return (
        f"{row['cell']:<24}{row['world']:<10}{row['ended']:<9}{number('duration_s', 2):>8}"
        f"{number('depth_mm', 2):>10}{number('error_rms_mm', 3):>10}{number('latency_ms', 0):>11}"
        f"{number('late_percent', 1):>7}{number('apart_mm', 2):>10}{number('shift_s', 0, 1e3):>9}"
        f"{number('shifted_mm', 2):>8}{reason}"
    )
