"""The wall clock of all processes of a cell is set an hour ahead and back while two arms work: nothing may happen.

``clock_shim.c``, between programs and the kernel, steps CLOCK_REALTIME and leaves CLOCK_MONOTONIC unchanged, as
``date --set`` does, but for the cell only. (libfaketime 0.9.10 cannot: with the monotonic clock unchanged its
``clock_nanosleep`` fails with EINVAL, and so does every ``time.sleep``.)
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.fault_injection.process_faults import TooBusy, await_motion, last_line, left_over, running_cell, speed_m_s
from touchcell.drivers.hosting.layouts import RecordReader

STEPS_S: Final = (3600, -3600)
_WATCHED_S: Final = 1.0
_SEEN_WITHIN_S: Final = 1.0
_SOURCE: Final = Path(__file__).with_name("clock_shim.c")


@dataclass(frozen=True, slots=True)
class StepCase:
    """Result of one cell whose clock was set twice.

    Attributes:
        stepped_s: difference of the task's wall clock and its monotonic one at the end.
        fastest_m_s: the slower arm's highest speed after each step.
        outcome: last line of the task's process.
        problems: deviations from the expected behaviour.
    """

    stepped_s: float
    fastest_m_s: Sequence[float]
    outcome: Mapping[str, Any]
    problems: Sequence[str] = ()


def clock_shim(folder: Path) -> Path | None:
    """Build the shim in ``folder``; None where there is no C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    library = folder / "clock_shim.so"
    subprocess.run([compiler, "-O2", "-fPIC", "-shared", "-o", str(library), str(_SOURCE), "-ldl"], check=True)
    return library


def run_steps(folder: Path, library: Path, rate_hz: float, what: str = "sway") -> StepCase:
    """Let two arms ``sway`` or ``push`` and step the clock of all processes.

    Raises:
        TooBusy: the cell did not run long enough for the step, or was stopped for its loop's lateness, as happens on a
            busy machine without a step.
    """
    folder.mkdir(parents=True, exist_ok=True)
    offset = folder / "offset"
    offset.write_bytes(_seconds(0))
    environment = {"LD_PRELOAD": str(library), "TOUCHCELL_CLOCK": str(offset)}
    problems: list[str] = []
    fastest: list[float] = []
    with (
        running_cell(folder, rate_hz, what, environment) as (process, who, states),
        # Written in place: all processes have mapped it.
        offset.open("r+b", buffering=0) as setting,
    ):
        pids = [who["task"], who["watchdog"], *who["hosts"].values()]
        # The same file steps all of them.
        problems += [f"process {pid} is not under the shim" for pid in pids if not _has(pid, library)]
        await_motion(process, states, what)
        stops = {name: int(state.read()["stop_ns"]) for name, state in states.items()}
        for step_s in STEPS_S:
            os.pwrite(setting.fileno(), _seconds(step_s), 0)
            fastest.append(_fastest(states))
            if process.poll() is not None:
                problems.append(f"the cell ended after a step to {step_s:+d} s")
        problems += [f"{name} was stopped" for name, state in states.items() if state.read()["stop_ns"] != stops[name]]
        process.terminate()
        outcome = last_line(process)
        problems += left_over(pids)
    causes = outcome.get("causes") or []
    if any("loop" in reason for _, _, reason in causes):
        raise TooBusy(f"it stopped by itself: {causes}")
    stepped_s = float(outcome.get("clock_stepped_s", 0.0))
    if abs(stepped_s - STEPS_S[-1]) > _SEEN_WITHIN_S:
        problems.append(f"the task's wall clock moved by {stepped_s:.0f} s, not by {STEPS_S[-1]} s")
    if causes or outcome.get("outcome") not in ("done", "stopped"):
        problems.append(f"the run ended {outcome.get('outcome')}: {causes}")
    return StepCase(stepped_s, fastest, outcome, problems)


def _fastest(states: Mapping[str, RecordReader]) -> float:
    """Return the highest speed (m/s) of the slower arm in the time after a step."""
    highest = dict.fromkeys(states, 0.0)
    deadline_s = time.monotonic() + _WATCHED_S
    while time.monotonic() < deadline_s:
        for name, state in states.items():
            highest[name] = max(highest[name], speed_m_s(state.read()))
        time.sleep(0.005)
    return min(highest.values())


def _seconds(number: int) -> bytes:
    return number.to_bytes(8, "little", signed=True)


def _has(pid: int, library: Path) -> bool:
    return library.name in Path(f"/proc/{pid}/maps").read_text()
