"""What recording a control cycle costs the control thread, beside an earlier version, in turns.

    python -m benchmarks recording --against CHECKOUT [--rounds N]

Cells that ship run for 8 s of their own time with both versions, from the same cell file of the earlier one; the CPU
time of the thread in each cycle's recording, black box included, is measured around the method that does it: its
median, and its mean, in which pictures for viewers and the writing of chunks count too. The bytes of the file are
divided by the cycles, without its attachments, which are there once however long a run is. Of each the median over
rounds counts. The earlier version, 0.1.0, records JSON that viewers do not draw; this one also records what they draw,
and how near the interlocks are to their limits.

In a run, images and networks take the caches from what records, and other work on the machine takes more. The writers
alone are therefore compared too: both write the same messages of one of these runs, cycle by cycle, from a file in
memory; of five times the quickest counts.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

import yaml
from mcap.reader import make_reader

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.recording.mcap import RECORDING, read
from touchcell.paths import CHECKOUT

AIM: Final = 0.6
CELLS: Final = ("surface_follow_sim.yaml", "surface_follow_dome_sim.yaml")
_RUN: Final = """
import json, sys, time
cell, out = sys.argv[1:]
try:
    from touchcell.cell.cli.main import main
    from touchcell.cell.runtime.run_record import RunRecord as owner
    name = "cycle"
except ModuleNotFoundError:
    from cell.cli import main
    from cell.loop import RunLoop as owner
    name = "_record"
spent, record = [], getattr(owner, name)
def measured(self, *arguments):
    started = time.thread_time_ns()
    record(self, *arguments)
    spent.append(time.thread_time_ns() - started)
setattr(owner, name, measured)
sys.argv = ["touchcell"]
code = main(["run", cell, "--quiet", "--out", out])
spent = sorted(spent[50:])
mean = sum(spent) / len(spent)
print(json.dumps({"us": 1e-3 * spent[len(spent) // 2], "mean_us": 1e-3 * mean, "cycles": len(spent) + 50}))
"""

_WRITE: Final = """
import json, sys, tempfile, time
from pathlib import Path
try:
    from touchcell.cell.recording.recorder import Recorder
    now = True
except ModuleNotFoundError:
    from cell.recording import Recorder
    now = False
cycles = json.loads(Path(sys.argv[1]).read_text())
quickest = 1e9
for _ in range(5):
    with tempfile.TemporaryDirectory() as folder, Recorder(Path(folder) / "run.mcap") as recorder:
        started = time.thread_time_ns()
        for messages in cycles:
            if now:
                encode = recorder.encoder.encode
                recorder.write_encoded([(topic, t_ns, encode(topic, data)) for topic, t_ns, data in messages])
            else:
                for topic, t_ns, data in messages:
                    recorder.write(topic, t_ns, data)
        quickest = min(quickest, time.thread_time_ns() - started)
print(1e-3 * quickest / len(cycles))
"""


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``recording.json`` into ``out``."""
    parser = argparse.ArgumentParser("python -m benchmarks recording", description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3, help="repetitions (default: %(default)s)")
    parser.add_argument("--against", type=Path, required=True, metavar="CHECKOUT", help="of 0.1.0, with its own .venv")
    options = parser.parse_args(arguments)
    report: dict[str, Any] = {**provenance(), "rounds": options.rounds}
    columns = {"us": "CPU us", "mean_us": "mean us", "bytes": "bytes"}
    headings = "".join(f"{f'{name} then':>14}{'now':>6}{'ratio':>7}" for name in columns.values())
    print(f"{'recording one cycle':<26}{headings}")
    for cell in CELLS:
        rows: dict[str, list[dict[str, float]]] = {"then": [], "now": []}
        for _ in range(options.rounds):
            for when, at in (("then", options.against.resolve()), ("now", CHECKOUT)):
                rows[when].append(_run(at, options.against.resolve() / "configs" / cell))
        found = {when: {key: median(row[key] for row in each) for key in columns} for when, each in rows.items()}
        then, now = found["then"], found["now"]
        ratios = {key: now[key] / then[key] for key in then}
        rows_now = "".join(f"{then[key]:14.0f}{now[key]:6.0f}{ratios[key]:7.2f}" for key in columns)
        print(f"{Path(cell).stem:<26}{rows_now}")
        report[cell] = {**found, "ratio": ratios}
    alone = _writers_alone(options.against.resolve())
    print(f"the writers alone, CPU us a cycle: {alone['then']:.1f} then, {alone['now']:.1f} now: ", end="")
    print(f"{alone['now'] / alone['then']:.2f}")
    report["writers_alone_us"] = alone
    print(f"the aim: at most {AIM:g} of the CPU time; medians over {options.rounds} rounds in turns")
    (out / "recording.json").write_text(json.dumps(report, indent=1) + "\n")


def _run(checkout: Path, cell: Path) -> dict[str, float]:
    """Run a cell with a checkout's own code; returns CPU us and bytes of recording a cycle."""
    with tempfile.TemporaryDirectory() as name:
        folder, data = Path(name), yaml.safe_load(cell.read_text())
        path, out = folder / "cell.yaml", folder / "run"
        path.write_text(yaml.safe_dump({**data, "max_duration_s": 8}))
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        done = subprocess.run(
            [str(checkout / ".venv" / "bin" / "python"), "-c", _RUN, str(path), str(out)],
            cwd=checkout,
            capture_output=True,
            text=True,
            check=True,
            env={**environment, "OMP_NUM_THREADS": "1"},
        )
        found = json.loads(done.stdout.splitlines()[-1])
        recording = out / "run.mcap"
        with recording.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        attached = 0 if summary is None else sum(each.length for each in summary.attachment_indexes)
        return {
            "us": found["us"],
            "mean_us": found["mean_us"],
            "bytes": (recording.stat().st_size - attached) / found["cycles"],
        }


def _writers_alone(against: Path) -> dict[str, float]:
    """Return CPU us a cycle of writing the same messages with both versions."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = yaml.safe_load((against / "configs" / CELLS[0]).read_text())
        (folder / "cell.yaml").write_text(yaml.safe_dump({**data, "max_duration_s": 8}))
        command = [sys.executable, "-m", "touchcell", "run", str(folder / "cell.yaml"), "--quiet", "--out"]
        subprocess.run([*command, str(folder / "run")], capture_output=True, check=False)
        cycles: list[list[tuple[str, int, dict[str, Any]]]] = [[]]
        for message in read(folder / "run" / RECORDING):
            cycles[-1].append((message.topic, message.t_ns, message.data))
            if message.topic == "/timing":
                cycles.append([])
        (folder / "cycles.json").write_text(json.dumps([each for each in cycles if each]))
        found = {}
        for when, at in (("then", against), ("now", CHECKOUT)):
            command = [str(at / ".venv" / "bin" / "python"), "-c", _WRITE, str(folder / "cycles.json")]
            done = subprocess.run(command, cwd=at, capture_output=True, text=True, check=True)
            found[when] = float(done.stdout)
        return found
