"""From a hand to the wire and back to rest: what an operator who moves an arm waits for.

    python -m benchmarks jog [--times N]

The shipped surface-following cell is moved by hand at its own rate, 100 Hz, in step with real time and on the true
contact, by other processes: one that reads an input device, faked at the boundary of its library, and a page's
WebSocket through the server of ``touchcell ui``. ``input to wire`` is the time from a press to the return of the
driver's ``send_twist`` with the first command that moves. ``to rest`` is the time from letting go, closing the page's
connection, or SIGKILL to the device's process, until the arm is measured to stand; it is declared to be the dead-man
time and what the arm's own stop may take.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.jog_operator import HELD_S
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.jog_plan import jog_settings
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.jog_channel import JogChannel, JogInputs
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_input import reachable
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.stopping import declared_stop
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.jog import JogInput

CELL: Final = "surface_follow_sim.yaml"
AIM_MS: Final = 20.0
_REST_M_S: Final = 1e-4
_KINDS: Final = ("device", "killed", "page", "closed")


class Watched:
    """An arm's ``send_twist`` and its state in each cycle, with the time on CLOCK_MONOTONIC.

    Args:
        cell: its first arm is watched.
    """

    def __init__(self, cell: Cell) -> None:
        self._arm: Any = cell.arms["arm"]
        self.sent: list[tuple[int, float]] = []
        self.measured: list[tuple[int, float]] = []
        self._period_s = 1.0 / cell.rate_hz
        self._next_s = time.monotonic()
        send = self._arm.send_twist

        def send_twist(command: Any, lease: Any) -> Any:
            found = send(command, lease)
            self.sent.append((time.monotonic_ns(), float(np.linalg.norm(command.twist[:3]))))
            return found

        self._arm.send_twist = send_twist

    def after_cycle(self, progress: Progress) -> None:
        """Take note of the arm's measured speed."""
        speed = float(np.linalg.norm(self._arm.tcp().value.twist[:3]))
        self.measured.append((time.monotonic_ns(), speed))
        # As `touchcell jog` keeps simulated devices in step with a person's time.
        self._next_s = max(self._next_s + self._period_s, time.monotonic() - self._period_s)
        time.sleep(max(self._next_s - time.monotonic(), 0.0))


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``jog.json`` into ``out``."""
    parser = argparse.ArgumentParser("python -m benchmarks jog", description=__doc__.partition("\n")[0])
    parser.add_argument("--times", type=int, default=50, help="presses of each kind (default: %(default)s)")
    options = parser.parse_args(arguments)
    logging.getLogger("touchcell").setLevel(logging.ERROR)
    path = find_cell(Path(CELL))
    settings, _ = jog_settings(path, None, {"sensors.sensor.estimator": {"kind": "true_contact"}})
    plan = plan_cell(path, settings={**settings, "task.idle_timeout_s": 1e5})
    inputs: list[JogInput] = []
    cell = compose(plan, jog_input=_Later(inputs))
    watched, stop = Watched(cell), StopRequest()
    dead_man_s = 1e-3 * float(getattr(plan.task_config, "dead_man_ms"))  # noqa: B009
    found: dict[str, list[list[tuple[str, int]]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        folder.mkdir()
        (folder / "cell.yaml").write_text(plan.text())
        with (
            reachable(folder),
            Recorder(folder / RECORDING) as recorder,
            JogChannel(folder, stop, lambda arm, name: "") as channel,
            cell,
        ):
            inputs.append(JogInputs(None, channel))
            operating = threading.Thread(target=_operate, args=(folder, options.times, found, stop))
            operating.start()
            result = RunLoop(cell, recorder, stop=stop, on_cycle=watched.after_cycle).run()
            operating.join()
    limits = getattr(plan.devices["arm"].config, "limits", LimitsConfig())
    speed_m_s = max((speed for _, speed in watched.measured), default=0.0)
    stop_s, _ = declared_stop(speed_m_s, limits.tcp_accel_m_s2)
    declared_ms = 1e3 * (dead_man_s + stop_s)
    print(f"{result.outcome.value}: {result.reason or 'no reason'}; {result.cycles} cycles")
    print(f"{'':<34}{'median':>9}{'p99':>8}{'largest':>9}{'within':>12}")
    report: dict[str, Any] = {**provenance(), "cell": CELL, "times": options.times, "declared_ms": declared_ms}
    presses = sorted(t_ns for parts in found.values() for part in parts for what, t_ns in part if what == "press")
    for kind, parts in found.items():
        report[kind] = _judged(kind, [each for part in parts for each in part], presses, watched, declared_ms)
    print(f"aims: input to wire p99 below {AIM_MS:g} ms; at rest within {declared_ms:.0f} ms, which is declared")
    (out / "jog.json").write_text(json.dumps(report, indent=1) + "\n")


class _Later:
    """Jog input that is there once the run folder is."""

    def __init__(self, inputs: list[JogInput]) -> None:
        self._inputs = inputs

    def request(self, now_ns: int) -> Any:
        return self._inputs[0].request(now_ns) if self._inputs else None


def _operate(folder: Path, times: int, found: dict[str, list[list[tuple[str, int]]]], stop: StopRequest) -> None:
    """Let each operator do its work, one after the other, and end the run."""
    page = subprocess.Popen(
        [sys.executable, "-m", "touchcell.cell.ui.beside", str(folder), "0", "--moves"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert page.stdout is not None
        address = page.stdout.readline().partition(": ")[2].strip()
        for kind in _KINDS:
            for k in range(times if kind == "killed" else 1):
                found.setdefault(kind, []).append(_events(kind, folder, 1 if kind == "killed" else times, k, address))
    finally:
        stop.ask()
        page.terminate()
        page.wait()


def _events(kind: str, folder: Path, times: int, seed: int, address: str) -> list[tuple[str, int]]:
    """Run one operator, and return what happened when."""
    command = [sys.executable, "-m", "benchmarks.jog_operator", kind, str(folder), str(times), str(seed), address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as operator:
        assert operator.stdout is not None
        found = []
        for line in operator.stdout:
            what, _, t_ns = line.strip().rpartition(" ")
            found.append((what, int(t_ns)))
            if kind == "killed":
                time.sleep(HELD_S)
                found.append(("let go", time.monotonic_ns()))
                operator.kill()
        return found


def _judged(
    kind: str, events: Sequence[tuple[str, int]], presses: Sequence[int], watched: Watched, declared_ms: float
) -> dict[str, Any]:
    """Print and return how long it took to move, and to rest."""
    moved: list[float] = []
    rested: list[float] = []
    missed = 0
    for what, t_ns in events:
        next_ns = next((at for at in presses if at > t_ns), 1 << 62)
        if what == "press":
            first = next((at for at, speed in watched.sent if at >= t_ns and speed > 0.0), None)
            if first is None or first > next_ns:
                missed += 1
            else:
                moved.append(1e-6 * (first - t_ns))
            continue
        # The last cycle in which it moved, before it is moved again.
        last = [at for at, speed in watched.measured if t_ns <= at < next_ns and speed > _REST_M_S]
        after = [at for at, _ in watched.measured if at > (last[-1] if last else t_ns)]
        rested.append(1e-6 * (after[0] - t_ns) if after else float("inf"))
    within = sum(each <= declared_ms for each in rested)
    wire = _row(f"{kind}: input to wire", moved, sum(each < AIM_MS for each in moved), len(moved) + missed)
    end = {"device": "let go", "page": "let go", "killed": "device's process killed", "closed": "page closed"}[kind]
    rest = _row(f"{kind}: {end}, to rest", rested, within, len(rested))
    return {"input_to_wire_ms": wire, "to_rest_ms": rest}


def _row(title: str, ms: Sequence[float], within: int, of: int) -> dict[str, float]:
    values = np.array(ms) if ms else np.array([np.nan])
    row = {"median": float(np.median(values)), "p99": float(np.percentile(values, 99)), "largest": float(values.max())}
    print(f"{title:<34}{row['median']:9.1f}{row['p99']:8.1f}{row['largest']:9.1f}{f'{within} of {of}':>12}")
    return {**row, "within": within, "of": of}
