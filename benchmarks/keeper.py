"""``touchcell bench keeper``: where an arm without brakes is after its client, or its keeper, has been killed.

The arm is six emulated Damiao motors; its tool rises at 50 mm/s when the process is killed (SIGKILL) or frozen
(SIGSTOP). Positions are the emulator's truth.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.damiao.driver import DamiaoCanArm, DamiaoCanConfig
from touchcell.drivers.damiao.rig import config
from touchcell.paths import CHECKOUT
from touchcell.testing.emulation.process import EmulatorProcess

_SPEED_M_S = 0.05
_MOVING_S = 1.0
_HELD_S = 1.0
_MEAN_S = 0.2
_SAMPLE_S = 0.02
_CLIENT = "import sys; from benchmarks.keeper import move; move(sys.argv[1], sys.argv[2] == 'kept')"


@dataclass(frozen=True, slots=True)
class Fall:
    """What one kill led to.

    Attributes:
        arm: "kept" or "alone".
        killed: which process, and how.
        held_mm: greatest distance of the tool from where it was, within the first second.
        lowered_mm: greatest distance in all.
        fastest_mm_s: greatest speed, mean over 0.2 s.
        off_s: time until the first motor was disabled; None if none was.
    """

    arm: str
    killed: str
    held_mm: float
    lowered_mm: float
    fastest_mm_s: float
    off_s: float | None


def move(channel: str, kept: bool) -> None:
    """Move an arm up until this process is killed; prints the process id of its keeper, then that it moves."""
    clock = MonotonicClock()
    arm = DamiaoCanArm("arm", _config(Path(channel), kept=kept), clock)
    arm.connect()
    arm.configure()
    arm.activate()
    lease = arm.acquire("bench")
    print(arm.health()["keeper_pid"], flush=True)
    start_s = time.monotonic()
    told = False
    while True:
        twist = np.array([0.0, 0.0, _SPEED_M_S, 0.0, 0.0, 0.0])
        arm.send_twist(TwistCommand(twist, TwistFrame.BASE, clock.now_ns(), 0.2), lease)
        if not told and time.monotonic() - start_s > _MOVING_S:
            print("moving", flush=True)
            told = True
        time.sleep(_SAMPLE_S)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print a table of what each kill led to; writes ``keeper.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench keeper", description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=50.0, help="how long each arm is watched")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    print(f"{'arm':<8}{'killed':<18}{'within 1 s':>12}{'in all':>10}{'fastest':>12}{'motors off':>12}")
    falls = []
    for arm, killed, seconds in (
        ("alone", "client, SIGKILL", 2.0),
        ("kept", "client, SIGKILL", options.seconds),
        ("kept", "client, SIGSTOP", options.seconds),
        ("kept", "keeper, SIGKILL", 2.0),
    ):
        for _ in range(options.repeats):
            fall = _fall(arm, killed, seconds)
            falls.append(fall)
            off = "-" if fall.off_s is None else f"{fall.off_s:.2f} s"
            print(
                f"{arm:<8}{killed:<18}{fall.held_mm:9.1f} mm{fall.lowered_mm:7.0f} mm"
                f"{fall.fastest_mm_s:7.0f} mm/s{off:>12}",
                flush=True,
            )
    out.mkdir(parents=True, exist_ok=True)
    rows = [asdict(fall) for fall in falls]
    (out / "keeper.json").write_text(json.dumps({"provenance": provenance(), "falls": rows}, indent=1) + "\n")


def _config(channel: Path, *, kept: bool) -> DamiaoCanConfig:
    return config(channel, keeper=kept, rate_hz=50.0, max_missed_fraction=0.98)


def _fall(arm: str, killed: str, seconds: float) -> Fall:
    with tempfile.TemporaryDirectory(prefix="touchcell-keeper-") as folder:
        channel = Path(folder) / "can"
        tool = config(channel).tool.model_dump_json()
        with EmulatorProcess("damiao", str(channel), "--tool", tool, timeout_s=30.0) as emulator:
            client = subprocess.Popen(
                [sys.executable, "-c", _CLIENT, str(channel), arm], stdout=subprocess.PIPE, text=True, cwd=CHECKOUT
            )
            assert client.stdout is not None
            keeper = int(client.stdout.readline())
            try:
                client.stdout.readline()
                victim = keeper if killed.startswith("keeper") else client.pid
                path, off_s = _watch(emulator, victim, killed, seconds)
            finally:
                client.kill()
                client.wait()
                client.stdout.close()
                with suppress(ProcessLookupError):
                    if keeper:
                        os.kill(keeper, signal.SIGKILL)
    away_mm = 1e3 * np.linalg.norm(path[:, 1:] - path[0, 1:], axis=1)
    later = np.searchsorted(path[:, 0], path[:, 0] + _MEAN_S)
    inside = later < len(path)
    moved_mm = 1e3 * np.linalg.norm(path[later[inside], 1:] - path[inside, 1:], axis=1)
    speeds = moved_mm / (path[later[inside], 0] - path[inside, 0])
    held_mm = float(away_mm[path[:, 0] < _HELD_S].max())
    return Fall(arm, killed, held_mm, float(away_mm.max()), float(speeds.max()), off_s)


def _watch(emulator: EmulatorProcess, victim: int, killed: str, seconds: float) -> tuple[np.ndarray, float | None]:
    """Kill ``victim``; return rows of time s and tool position m, and when the first motor was disabled."""
    first = emulator.state()["position_m"]
    os.kill(victim, signal.SIGSTOP if killed.endswith("STOP") else signal.SIGKILL)
    start_s = time.monotonic()
    rows = [(0.0, *first)]
    off_s = None
    while (t_s := time.monotonic() - start_s) < seconds:
        state = emulator.state()
        rows.append((t_s, *state["position_m"]))
        if off_s is None and state["enabled"] < len(state["status"]):
            off_s = t_s
        time.sleep(_SAMPLE_S)
    return np.array(rows), off_s
