"""A cell with two simulated arms that sway to and fro, each in a process of its own: for faults of the watchdog chain.

``python -m benchmarks.two_arms FOLDER RATE_HZ`` runs it until it is told to end or something stops it, and tells on
standard output who takes part. SIGUSR1 and a word in the file ``fault`` of the folder make something go wrong inside.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from cell.blackbox import BlackBox
from cell.compose import Cell, compose
from cell.config import CellFile, CellPlan, DevicePlan
from cell.loop import RunLoop, StopRequest
from cell.processes import ProcessWatch
from cell.recording import Recorder
from drivers import registry
from drivers.commands import TwistCommand, TwistFrame
from tasks.interface import Action, Observation, TaskConfig, TaskContext, TaskSpec, TransitionRecord

SPEED_M_S: Final = 0.03
PERIOD_S: Final = 2.0
_ABILITIES: Final = frozenset({"TcpSource", "TwistSink", "Stoppable"})


class Sway:
    """Both arms to and fro along x; finished when a person asks, or when the supervisor trips."""

    def __init__(self, config: TaskConfig, context: TaskContext) -> None:
        self._ttl_s = 3.0 / context.rate_hz
        self.state = "sway"
        self.finished = False
        self.succeeded = False
        self.transitions: tuple[TransitionRecord, ...] = ()

    def tick(self, observation: Observation) -> Action:
        """A twist for each arm, in opposite directions."""
        now_ns = observation.now_ns
        if observation.operator_stop:
            self.finished = self.succeeded = True
            return Action()
        # A square wave is fastest almost always, which is the worst moment for a fault.
        speed_m_s = math.copysign(SPEED_M_S, math.sin(2.0 * math.pi * now_ns * 1e-9 / PERIOD_S))
        twist = np.array([speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0])
        return Action(
            {
                role: TwistCommand(sign * twist, TwistFrame.BASE, now_ns, self._ttl_s)
                for role, sign in (("left", 1.0), ("right", -1.0))
            }
        )

    def trip(self, now_ns: int, reason: str) -> None:
        """Nothing moves from here on."""
        self.state, self.finished = "tripped", True


SPEC: Final = TaskSpec(
    name="sway",
    summary="two arms to and fro",
    config=TaskConfig,
    arms={"left": _ABILITIES, "right": _ABILITIES},
    sensors=frozenset(),
    build=Sway,
)


def two_arm_plan(
    folder: Path, rate_hz: float, *, processes: str = "separate", categories: Mapping[str, int] | None = None
) -> CellPlan:
    """The plan of the cell: no scene, so that each arm is a group by itself."""
    driver = registry.spec("sim_arm")
    places = {"left": -300.0, "right": 300.0}
    arms = {
        name: {
            "driver": "sim_arm",
            "deactivate": "hold",
            "stop_category": (categories or {}).get(name, 2),
            "start_pose_mm_deg": (x_mm, 0.0, 200.0, 180.0, 0.0, 0.0),
        }
        for name, x_mm in places.items()
    }
    cell = CellFile.model_validate(
        {
            "schema": 1,
            "name": "two_arms",
            "time": "real",
            "rate_hz": rate_hz,
            "processes": processes,
            "arms": arms,
            "task": {"name": SPEC.name},
        }
    )
    devices = {
        name: DevicePlan(name, driver, driver.config.model_validate(section.model_extra))
        for name, section in cell.arms.items()
    }
    roles = {name: name for name in devices}
    return CellPlan(folder / "cell.yaml", cell, devices, {}, roles, {}, SPEC, TaskConfig(), (), devices)


def _participants(cell: Cell) -> dict[str, Any]:
    """Processes and descriptors, by which somebody outside can hurt them and read the hosts' records."""
    watch = cell.watch
    assert isinstance(watch, ProcessWatch)
    return {
        "task": os.getpid(),
        "watchdog": watch.chain.watchdog.pid,
        "hosts": {link.name: link.pid for link in watch.chain.hosts},
        "states": watch.chain.state_fds,
        "proofs": [[proof.link, proof.time_s, proof.declared_s] for proof in watch.proofs],
        "period_s": watch.chain.period_s,
    }


class _InnerFault:
    """What goes wrong inside the task's process when SIGUSR1 comes."""

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


def main() -> None:
    """Run the cell; the last line on standard output tells how it ended."""
    folder, rate_hz = Path(sys.argv[1]), float(sys.argv[2])
    stop = StopRequest()
    signal.signal(signal.SIGTERM, lambda *_: stop.ask())
    signal.signal(signal.SIGUSR1, _InnerFault(folder))
    box = BlackBox()
    with Recorder(folder / "run.mcap") as recorder, compose(two_arm_plan(folder, rate_hz)) as cell:
        cell.watch.note_to(folder)
        print(json.dumps(_participants(cell)), flush=True)
        result = RunLoop(cell, recorder, box=box, stop=stop).run()
        causes = [[cause.interlock, cause.subject, cause.reason] for cause in result.causes]
        kind = type(result.error).__name__ if result.error else ""
        print(json.dumps({"outcome": result.outcome.value, "causes": causes, "error": kind}), flush=True)


if __name__ == "__main__":
    main()
