"""The wall clock of all processes of a cell is set an hour ahead and back, while two arms work: nothing may happen.

By libfaketime, which stands between programs and the kernel: it steps CLOCK_REALTIME and leaves CLOCK_MONOTONIC alone,
as ``date --set`` does, but for the cell only.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.process_faults import await_motion, last_line, left_over, running_cell, speed_m_s
from drivers.process.layouts import RecordReader

STEPS_S: Final = (3600, -3600)
_WATCHED_S: Final = 1.0
_SEEN_WITHIN_S: Final = 1.0
_OFFSET: Final = "offset"


@dataclass(frozen=True, slots=True)
class StepCase:
    """What became of one cell whose clock was set twice.

    Attributes:
        stepped_s: by how much the task's wall clock differed from its monotonic one at the end.
        fastest_m_s: the slower arm's highest speed after the steps, each.
        outcome: last line of the task's process.
        problems: what happened, where nothing should have.
    """

    stepped_s: float
    fastest_m_s: Sequence[float]
    outcome: Mapping[str, Any]
    problems: Sequence[str] = ()


def faketime() -> Path | None:
    """The library, or None where it is not installed (Debian: libfaketime)."""
    found = sorted(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
    return found[0] if found else None


def run_steps(folder: Path, library: Path, rate_hz: float, what: str = "sway") -> StepCase:
    """Let two arms ``sway`` or ``push`` and step the clock of all processes.

    Raises:
        TooBusy: the cell did not run long enough to be hurt.
    """
    folder.mkdir(parents=True, exist_ok=True)
    offset = folder / _OFFSET
    offset.write_text("+0\n")
    environment = {
        "LD_PRELOAD": str(library),
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_TIMESTAMP_FILE": str(offset),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DISABLE_SHM": "1",
    }
    problems: list[str] = []
    fastest: list[float] = []
    with running_cell(folder, rate_hz, what, environment) as (process, who, states):
        pids = [who["task"], who["watchdog"], *who["hosts"].values()]
        # The same file steps all of them.
        problems += [f"process {pid} is not under libfaketime" for pid in pids if not _has(pid, library)]
        await_motion(process, states)
        stops = {name: int(state.read()["stop_ns"]) for name, state in states.items()}
        for step_s in STEPS_S:
            offset.write_text(f"{step_s:+d}\n")
            fastest.append(_fastest(states))
            if process.poll() is not None:
                problems.append(f"the cell ended after a step to {step_s:+d} s")
        problems += [f"{name} was stopped" for name, state in states.items() if state.read()["stop_ns"] != stops[name]]
        process.terminate()
        outcome = last_line(process)
        problems += left_over(pids)
    stepped_s = float(outcome.get("clock_stepped_s", 0.0))
    if abs(stepped_s - STEPS_S[-1]) > _SEEN_WITHIN_S:
        problems.append(f"the task's wall clock moved by {stepped_s:.0f} s, not by {STEPS_S[-1]} s")
    if outcome.get("causes") or outcome.get("outcome") not in ("done", "stopped"):
        problems.append(f"the run ended {outcome.get('outcome')}: {outcome.get('causes')}")
    return StepCase(stepped_s, fastest, outcome, problems)


def _fastest(states: Mapping[str, RecordReader]) -> float:
    """Highest speed (m/s) of the slower arm in the time after a step."""
    highest = dict.fromkeys(states, 0.0)
    deadline_s = time.monotonic() + _WATCHED_S
    while time.monotonic() < deadline_s:
        for name, state in states.items():
            highest[name] = max(highest[name], speed_m_s(state.read()))
        time.sleep(0.005)
    return min(highest.values())


def _has(pid: int, library: Path) -> bool:
    return library.name in Path(f"/proc/{pid}/maps").read_text()
