"""Faults of whole processes while two arms move, judged by the hosts' own records of the arms.

The cells are those of ``tests.fault_injection.two_arms``, in their own process tree. Only the records of the hosts are
trusted; they are read from shared memory, also when the processes have ended.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from tests.fault_injection.two_arms import PERIOD_S, SPEED_M_S, left_speed_m_s, pushing_emulators
from touchcell.cell.runtime.watchdog import NOTES
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.hosting.layouts import ARM, RecordReader
from touchcell.drivers.hosting.watchdog import silence_s

_READY_S: Final = 60.0
_MOVING_S: Final = 30.0
_MOVING_M_S: Final = 0.005
_WATCHED_S: Final = 8.0
_AFTERWARDS_S: Final = 0.3
_END_S: Final = 30.0
_STEADY_S: Final = 0.1
MARGIN_S: Final = {"sway": 0.1, "push": 0.2}
"""Extra time of a stop: an emulated arm blends its motion, and reports rest with a delay."""

_numbers = itertools.count(os.getpid())


@dataclass(frozen=True, slots=True)
class ProcessFault:
    """A fault of a process.

    Attributes:
        name: description.
        who: "task", "watchdog", or "host" for the first of these.
        signal: signal that it is sent.
        inner: command for ``process_victim``, for faults within the task's process.
        at_once: True if it takes effect when injected; a full disk takes effect at the next write.
    """

    name: str
    who: str
    signal: signal.Signals
    inner: str = ""
    at_once: bool = True


FAULTS: Final = (
    ProcessFault("task killed", "task", signal.SIGKILL),
    ProcessFault("task stopped", "task", signal.SIGSTOP),
    ProcessFault("watchdog killed", "watchdog", signal.SIGKILL),
    ProcessFault("watchdog stopped", "watchdog", signal.SIGSTOP),
    ProcessFault("host killed", "host", signal.SIGKILL),
    ProcessFault("host stopped", "host", signal.SIGSTOP),
    ProcessFault("task holds the GIL", "task", signal.SIGUSR1, "gil"),
    ProcessFault("task out of memory", "task", signal.SIGUSR1, "memory"),
    ProcessFault("disk full", "task", signal.SIGUSR1, "disk", at_once=False),
)


@dataclass(frozen=True, slots=True)
class ArmCase:
    """Result of one arm.

    Attributes:
        arm: its name.
        detected_s: from the fault until it was commanded to stop; None if no stop was needed.
        stop_s: from then until it was at rest; None if it never was.
        rest_s: from the fault until it was at rest.
        travelled_m: distance from its position at the fault.
    """

    arm: str
    detected_s: float | None
    stop_s: float | None
    rest_s: float | None
    travelled_m: float


@dataclass(frozen=True, slots=True)
class ProcessCase:
    """Result of one fault.

    Attributes:
        fault: the fault.
        arms: those whose host did not get the fault.
        declared_s: from the fault to rest, at most.
        outcome: last line of the task's process, empty if it had none.
        notes: the watchdog's note, empty if none.
        problems: deviations from the expected behaviour.
    """

    fault: ProcessFault
    arms: Sequence[ArmCase]
    declared_s: float
    outcome: Mapping[str, Any] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)
    problems: Sequence[str] = ()


class TooBusy(RuntimeError):
    """The cell stopped before the fault: the machine starved it."""


def declared_s(rate_hz: float, fastest_m_s: float, what: str = "sway") -> float:
    """Return the longest time (s) from a fault to rest: two missed beats, a cycle each, braking, margin."""
    limits = LimitsConfig().build()
    return silence_s(1.0 / rate_hz) + 1.0 / rate_hz + fastest_m_s / limits.accel_m_s2 + MARGIN_S[what]


def run_fault(folder: Path, fault: ProcessFault, rate_hz: float, what: str = "sway") -> ProcessCase:
    """Let two arms ``sway`` or ``push``, inject ``fault``, and judge by the hosts' records.

    Raises:
        TooBusy: the cell did not run long enough for the fault.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fault").write_text(fault.inner)
    with running_cell(folder, rate_hz, what) as (process, who, states):
        await_motion(process, states, what)
        host = next(iter(who["hosts"]))
        victim = {"task": who["task"], "watchdog": who["watchdog"], "host": who["hosts"][host]}[fault.who]
        faulty_arms = set(who["arms"][host]) if fault.who == "host" else set()
        before = {name: state.read() for name, state in states.items()}
        fault_ns = time.monotonic_ns()
        os.kill(victim, fault.signal)
        survivors = {name: state for name, state in states.items() if name not in faulty_arms}
        _await_rest(survivors)
        at_rest = {name: state.read() for name, state in survivors.items()}
        if fault.signal is signal.SIGSTOP:
            # The cell may have ended it meanwhile.
            with suppress(ProcessLookupError):
                os.kill(victim, signal.SIGCONT)
            _await_rest(states)
        time.sleep(_AFTERWARDS_S)
        afterwards = {name: state.read() for name, state in states.items()}
        process.send_signal(signal.SIGTERM)
        outcome = last_line(process)
        problems = left_over([who["task"], who["watchdog"], *who["hosts"].values()])
        arms = [_arm_case(name, before[name], record, fault_ns) for name, record in at_rest.items()]
        longest_s = declared_s(rate_hz, max(speed_m_s(record) for record in before.values()), what)
        for case in arms:
            problems += _judged(case, fault, longest_s)
        for name, record in afterwards.items():
            # A killed host executes no command any more, and its record ends where it was killed.
            if fault.signal is signal.SIGKILL and name in faulty_arms:
                continue
            if not record["at_rest"]:
                problems.append(f"{name} moved afterwards")
            if record["executed_ns"] > record["stop_ns"] > fault_ns or (
                name in at_rest and record["obeyed"] != at_rest[name]["obeyed"]
            ):
                problems.append(f"{name} obeyed a command after the stop")
        notes = json.loads((folder / NOTES).read_text()) if (folder / NOTES).exists() else {}
    return ProcessCase(fault, arms, longest_s, outcome, notes, problems)


def _judged(case: ArmCase, fault: ProcessFault, longest_s: float) -> list[str]:
    if case.rest_s is None or case.stop_s is None:
        return [f"{case.arm} did not come to rest"]
    # From its detection on, where that does not follow the fault at once.
    took_s = case.rest_s if fault.at_once else case.stop_s
    return [f"{case.arm} was at rest after {took_s:.3f} s, declared {longest_s:.3f} s"] if took_s > longest_s else []


def _arm_case(name: str, before: Any, record: Any, fault_ns: int) -> ArmCase:
    commanded = [int(record[key]) for key in ("requested_ns", "stop_ns") if record[key] > fault_ns]
    rested_ns = int(record["moved_ns"]) if record["at_rest"] else None
    detected_ns = min(commanded, default=None)
    return ArmCase(
        name,
        None if detected_ns is None else (detected_ns - fault_ns) * 1e-9,
        None if rested_ns is None else max(0, rested_ns - (detected_ns or fault_ns)) * 1e-9,
        None if rested_ns is None else max(0, rested_ns - fault_ns) * 1e-9,
        math.dist(record["T_base_tcp"][:3, 3], before["T_base_tcp"][:3, 3]),
    )


@contextmanager
def running_cell(
    folder: Path, rate_hz: float, what: str, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], dict[str, Any], dict[str, RecordReader]]]:
    """Yield the running cell, its processes, and the records of its arms."""
    command = [sys.executable, "-m", "tests.fault_injection.process_victim", str(folder), f"{rate_hz:g}", what]
    with ExitStack() as exits, (folder / "stderr").open("wb") as stderr:
        if what == "push":
            exits.enter_context(pushing_emulators(folder, next(_numbers)))
        process = subprocess.Popen(
            command,
            bufsize=0,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env=os.environ | {"OMP_NUM_THREADS": "1", **(environment or {})},
        )
        exits.enter_context(process)
        exits.callback(process.kill)
        assert process.stdout is not None
        if not select.select([process.stdout], [], [], _READY_S)[0]:
            raise TooBusy(f"not ready within {_READY_S:g} s")
        line = process.stdout.readline()
        if not line:
            raise TooBusy((folder / "stderr").read_text()[-400:])
        who = json.loads(line)
        states = {}
        for name, number in who["states"].items():
            fd = os.open(f"/proc/{who['task']}/fd/{number}", os.O_RDONLY)
            states[name] = exits.enter_context(RecordReader(fd, ARM))
            os.close(fd)
        yield process, who, states


def await_motion(process: subprocess.Popen[bytes], states: Mapping[str, RecordReader], what: str) -> None:
    """Return when both arms are at work, at full speed, and do not turn soon."""
    assert process.stdout is not None
    if not select.select([process.stdout], [], [], _MOVING_S)[0]:
        raise TooBusy(f"not at work within {_MOVING_S:g} s")
    if b"moving" not in (line := process.stdout.readline()):
        raise TooBusy(f"it stopped by itself: {line.decode()}")
    deadline_s, since_s = time.monotonic() + _MOVING_S, None
    while since_s is None or time.monotonic() < since_s + _STEADY_S:
        if process.poll() is not None or time.monotonic() > deadline_s:
            raise TooBusy("it stopped by itself")
        turns_soon = (time.monotonic() * 2.0 / PERIOD_S) % 1.0 > 0.5
        if turns_soon or not _at_full_speed(states, what):
            since_s = None
        elif since_s is None:
            since_s = time.monotonic()
        time.sleep(0.005)


def _at_full_speed(states: Mapping[str, RecordReader], what: str) -> bool:
    if what == "push":
        return min(speed_m_s(state.read()) for state in states.values()) > _MOVING_M_S
    # On a busy machine an arm may still move in the direction before the last turn, and turn at any moment.
    left_m_s = left_speed_m_s(time.monotonic_ns())
    wanted_m_s = {"left": left_m_s, "right": -left_m_s}
    return all(
        math.isclose(states[name].read()["twist"][0], v_m_s, abs_tol=1e-3 * SPEED_M_S)
        for name, v_m_s in wanted_m_s.items()
    )


def speed_m_s(record: Any) -> float:
    """Return the speed of the tool in a host's record."""
    return float(np.linalg.norm(record["twist"][:3]))


def _await_rest(states: Mapping[str, RecordReader]) -> None:
    """Return when all arms have been at rest for a while, or after a timeout."""
    deadline_s = time.monotonic() + _WATCHED_S
    standing_s = None
    while time.monotonic() < deadline_s and (standing_s is None or time.monotonic() < standing_s + _AFTERWARDS_S):
        if not all(state.read()["at_rest"] for state in states.values()):
            standing_s = None
        elif standing_s is None:
            standing_s = time.monotonic()
        time.sleep(0.005)


def last_line(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Return the cell's last output line; empty if there is none."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(_END_S)
    process.kill()
    assert process.stdout is not None
    lines = process.stdout.read().splitlines()
    return dict(json.loads(lines[-1])) if lines else {}


def left_over(pids: Sequence[int]) -> list[str]:
    """Return processes of the cell that still exist after its end; they are killed."""
    deadline_s = time.monotonic() + _END_S
    left = [pid for pid in pids if _alive(pid)]
    while left and time.monotonic() < deadline_s:
        time.sleep(0.02)
        left = [pid for pid in left if _alive(pid)]
    for pid in left:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return [f"process {pid} was left over" for pid in left]


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"
