"""The process into which ``process_faults`` injects faults: a cell with two arms that runs until it is stopped.

``python -m tests.fault_injection.process_victim FOLDER RATE_HZ sway|push`` prints its participants, then that the arms
move, and at the end the outcome of the run. SIGUSR1 and a command in the file ``fault`` of the folder cause a fault
inside.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

from tests.fault_injection.two_arms import pushing_plan, two_arm_plan
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.black_box import BlackBox
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.process_watchdog import ProcessWatchdog
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.stop_request import StopRequest

PLANS: Final = {"sway": two_arm_plan, "push": pushing_plan}
_MOVING_STATES: Final = ("sway", "run")
_MOVING_S: Final = 0.5


def _participants(cell: Cell) -> dict[str, Any]:
    """Return processes and descriptors, with which another process can inject faults and read the hosts' records."""
    watch = cell.watchdog
    assert isinstance(watch, ProcessWatchdog)
    return {
        "task": os.getpid(),
        "watchdog": watch.chain.watchdog.pid,
        "hosts": {link.name: link.pid for link in watch.chain.hosts},
        "states": watch.chain.state_fds,
        "arms": {group.name: [each.name for each in group.devices if each.is_arm] for group in watch.chain.groups},
        "proofs": [[proof.link, proof.time_s, proof.declared_s] for proof in watch.proofs],
        "period_s": watch.chain.period_s,
    }


class _InnerFault:
    """Fault inside the task's process, caused by SIGUSR1."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._balloon: list[bytearray] = []

    def __call__(self, *_: Any) -> None:
        match (self._folder / "fault").read_text():
            case "gil":
                # One instruction of the interpreter that takes seconds, in another thread.
                threading.Thread(target=pow, args=(7, 2_500_000), daemon=True).start()
            case "memory":
                used = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
                resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), used + (64 << 20)))
                while True:
                    self._balloon.append(bytearray(8 << 20))
            case "disk":
                written = (self._folder / "run.mcap").stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (written, written))


class _Announce:
    """Prints once that the arms have been at work for a while."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._said = False

    def __call__(self, progress: Progress) -> None:
        if progress.state not in _MOVING_STATES:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = progress.t_s
        elif not self._said and progress.t_s > self._since_s + _MOVING_S:
            self._said = True
            print(json.dumps({"moving": True}), flush=True)


def main() -> None:
    """Run the cell; the last line on standard output is the outcome."""
    folder, rate_hz, what = Path(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    stop = StopRequest()
    signal.signal(signal.SIGTERM, lambda *_: stop.ask())
    signal.signal(signal.SIGUSR1, _InnerFault(folder))
    box = BlackBox()
    wall_s = time.time() - time.monotonic()
    with Recorder(folder / "run.mcap") as recorder, compose(PLANS[what](folder, rate_hz)) as cell:
        cell.watchdog.note_to(folder)
        print(json.dumps(_participants(cell)), flush=True)
        result = RunLoop(cell, recorder, box=box, stop=stop, on_cycle=_Announce()).run()
        causes = [[cause.interlock, cause.subject, cause.reason] for cause in result.causes]
        kind = type(result.error).__name__ if result.error else ""
        stepped_s = time.time() - time.monotonic() - wall_s
        report = {"outcome": result.outcome.value, "causes": causes, "error": kind, "clock_stepped_s": stepped_s}
        print(json.dumps(report), flush=True)


if __name__ == "__main__":
    main()
