"""What viewers and the operator's page cost the control cycle, and what recording costs beside an earlier version.

    python -m benchmarks live [--rounds N] [--against CHECKOUT]

The shipped surface-following cell runs on the true contact at its own rate of 100 Hz, in turns: alone; served to
Foxglove viewers (``--live``), with no client and with one that subscribes to everything and reads nothing; and with the
operator's page (``--ui``) beside it, whose client reads nothing either. What counts is the CPU time of the loop's own
thread in a cycle, which other processes of a busy machine hardly change; the wall-clock time of each cycle stands
beside it. Of each figure the median of the rounds counts.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Final

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import RECORDING
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_input import reachable
from touchcell.cell.runtime.run_result import Progress
from touchcell.paths import CHECKOUT

CELL: Final = "surface_follow_sim.yaml"
AIM: Final = 0.05
"""Share of its p99 by which a cycle may become longer."""
RECORDING_AIM: Final = 0.6
_FIRST: Final = 50

_STUCK_VIEWER: Final = """
import json, sys, time
from websockets.sync.client import connect
with connect(sys.argv[1], subprotocols=["foxglove.sdk.v1"], open_timeout=20, max_queue=1) as viewer:
    channels = {}
    print("ready", flush=True)
    while len(channels) < 8:
        message = viewer.recv(timeout=20)
        if isinstance(message, str) and json.loads(message)["op"] == "advertise":
            channels |= {each["id"]: each for each in json.loads(message)["channels"]}
    wanted = [{"id": k, "channelId": channel} for k, channel in enumerate(channels)]
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    time.sleep(600)
"""
_STUCK_PAGE: Final = """
import re, sys, time, urllib.request
from http.cookiejar import CookieJar
from websockets.sync.client import connect
jar = CookieJar()
opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
html = opener.open(sys.argv[1], timeout=60).read().decode()
client = re.search(r"'client_id': '([^']+)'", html)[1]
host = sys.argv[1].split("/")[2]
query = f"client_id={client}&next_message_id=0&implicit_handshake=true&tab_id=stuck&document_id=stuck"
query += "&EIO=4&transport=websocket"
headers = {"Cookie": "; ".join(f"{each.name}={each.value}" for each in jar)}
with connect(f"ws://{host}/_nicegui_ws/socket.io/?{query}", origin=f"http://{host}",
             additional_headers=headers, open_timeout=60, max_queue=1) as page:
    page.recv(timeout=60)
    page.send("40")
    print("ready", flush=True)
    time.sleep(600)
"""


def run(arguments: Sequence[str], out: Path) -> None:
    """Print both tables; write ``live.json`` into ``out``."""
    parser = argparse.ArgumentParser("python -m benchmarks live", description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="repetitions of everything (default: %(default)s)")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="of 0.1.0, with its own .venv")
    options = parser.parse_args(arguments)
    cases: dict[str, Callable[[Recorder, Path], AbstractContextManager[None]]] = {
        "alone": lambda recorder, folder: nullcontext(),
        "--live, no client": _served,
        "--live, a stuck client": _served_to_a_stuck_viewer,
        "--ui, a stuck client": _beside_the_page,
    }
    # That interlocks of a network are left out on the true contact is known here.
    logging.getLogger("touchcell.cell.config.layers").setLevel(logging.ERROR)
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in cases}
    again: list[dict[str, float]] = []
    for _ in range(options.rounds):
        for name, around in cases.items():
            rounds[name].append(_cycles(around))
        again.append(_cycles(cases["alone"]))
    found = {name: {key: median(each[key] for each in rows) for key in rows[0]} for name, rows in rounds.items()}
    print(
        f"{'us of one cycle with its recording':<36}{'CPU median':>11}{'CPU p99':>9}{'wall median':>13}{'wall p99':>10}"
    )
    for name, row in found.items():
        print(f"{name:<36}{row['cpu_50']:11.0f}{row['cpu_99']:9.0f}{row['wall_50']:13.0f}{row['wall_99']:10.0f}")
    print(f"\n{'added to a cycle':<24}{'us':>6}{'of its p99':>12}{'median':>9}{'p99':>8}{'spread of the p99':>19}")
    shares = {name: _shares(rows, rounds["alone"]) for name, rows in rounds.items() if name != "alone"}
    # A second run alone in each round: what differs between two runs of the same, on this machine.
    shares["alone, once more"] = _shares(again, rounds["alone"])
    for name, share in shares.items():
        print(
            f"{name:<24}{share['added_us']:+6.0f}{share['of_p99']:+12.1%}{share['cpu_50']:+9.1%}{share['cpu_99']:+8.1%}"
            f"{share['spread']:19.1%}"
        )
    print(f"the aim: at most {AIM:.0%} of the p99; medians over rounds of pairs that ran one after the other")
    report = {**provenance(), "cell": CELL, "rounds": options.rounds, "cycles": found, "shares": shares}
    if options.against is not None:
        report["recording_us"] = _recording(options.against.resolve(), options.rounds)
    (out / "live.json").write_text(json.dumps(report, indent=1) + "\n")


def _cycles(around: Callable[[Recorder, Path], AbstractContextManager[None]]) -> dict[str, float]:
    """Run the cell once and return medians and 99th percentiles of its cycles, in us."""
    settings = {"sensors.sensor.estimator": {"kind": "true_contact"}, "task.distance_mm": 60}
    plan = plan_cell(find_cell(Path(CELL)), settings=settings)
    cell = compose(plan)
    cpu_ns: list[int] = []
    started_s = time.monotonic()

    def after_cycle(progress: Progress) -> None:
        cpu_ns.append(time.thread_time_ns())
        # Simulated time is never late, however busy the machine, and here never early.
        time.sleep(max(progress.t_s - (time.monotonic() - started_s), 0.0))

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        folder.mkdir()
        (folder / "cell.yaml").write_text(plan.text())
        with reachable(folder), Recorder(folder / RECORDING) as recorder, around(recorder, folder), cell:
            started_s = time.monotonic()
            times = RunLoop(cell, recorder, on_cycle=after_cycle).run().times.rows
    wall_ns = np.array(times["cycle"]) + np.array(times["record"])
    found: dict[str, float] = {}
    for kind, durations_ns in (("cpu", np.diff(cpu_ns)), ("wall", wall_ns)):
        # The first cycles make everything that is made once.
        us = 1e-3 * durations_ns[_FIRST:]
        found |= {f"{kind}_50": float(np.median(us)), f"{kind}_99": float(np.percentile(us, 99))}
    return found


def _shares(rows: Sequence[dict[str, float]], alone: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return by how much a case is above the one alone, the median over rounds, and half the spread of the p99's ratio.

    ``of_p99`` is what is added to the median cycle, beside the p99 of the one alone.
    """
    pairs = list(zip(rows, alone, strict=True))
    found = {key: median(row[key] / base[key] for row, base in pairs) - 1.0 for key in ("cpu_50", "cpu_99")}
    ratios = sorted(row["cpu_99"] / base["cpu_99"] for row, base in pairs)
    return {
        **found,
        "added_us": median(row["cpu_50"] - base["cpu_50"] for row, base in pairs),
        "of_p99": median((row["cpu_50"] - base["cpu_50"]) / base["cpu_99"] for row, base in pairs),
        "spread": 0.5 * (ratios[-1] - ratios[0]),
    }


@contextmanager
def _served(recorder: Recorder, folder: Path) -> Iterator[None]:
    with recorder.serve("live", 0):
        yield


@contextmanager
def _served_to_a_stuck_viewer(recorder: Recorder, folder: Path) -> Iterator[None]:
    with recorder.serve("live", 0) as address, _client(_STUCK_VIEWER, address):
        yield


@contextmanager
def _beside_the_page(recorder: Recorder, folder: Path) -> Iterator[None]:
    # The page needs something to show.
    recorder.write("/task", 0, {"state": "prepare"})
    command = [sys.executable, "-m", "touchcell.cell.ui.beside", str(folder), "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as page:
        try:
            assert page.stdout is not None
            address = page.stdout.readline().partition(": ")[2].strip()
            with _client(_STUCK_PAGE, address):
                yield
        finally:
            page.terminate()


@contextmanager
def _client(script: str, address: str) -> Iterator[None]:
    with subprocess.Popen([sys.executable, "-c", script, address], stdout=subprocess.PIPE, text=True) as client:
        try:
            assert client.stdout is not None
            if client.stdout.readline().strip() != "ready":
                raise RuntimeError(f"the client of {address} did not begin")
            yield
        finally:
            client.kill()


def _recording(checkout: Path, rounds: int) -> dict[str, float]:
    """Return the median time of recording one cycle in both checkouts, in us, measured in turns by ``bench cycle``."""
    then: list[float] = []
    now: list[float] = []
    for _ in range(rounds):
        for found, at in ((then, checkout), (now, CHECKOUT)):
            with tempfile.TemporaryDirectory() as folder:
                command = [str(at / ".venv" / "bin" / "touchcell"), "bench", "cycle", "--out", folder]
                subprocess.run(command, cwd=at, capture_output=True, check=True, timeout=600)
                stages = json.loads((Path(folder) / "cycle.json").read_text())["stages"]
                found.append(float(stages["record"]["median_us"]))
    before, after = median(then), median(now)
    kept = "within" if after <= RECORDING_AIM * before else "beyond"
    print(f"\nrecording one cycle, wall median: {checkout.name} {before:.0f} us, now {after:.0f} us: ", end="")
    print(f"{after / before:.2f}, {kept} the aim of {RECORDING_AIM:g}")
    return {"then": before, "now": after}
