"""``touchcell bench cost``: start-up time, memory and cycle time of a cell, with and without each part.

Each cell runs in a fresh process that does the same as ``touchcell run``, with its recording and its black box.
``ready`` counts from the start of the process until the first control cycle; memory is that of the process after the
last one, before the plots are made, and its peak.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from touchcell.cell.bench.perception import write_simulated
from touchcell.cell.bench.provenance import as_installed, provenance
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.drivers.replay.dataset import IMAGE_FOLDER

_REPLAYED = 120
_HEAVY = ("torch", "matplotlib", "onnxruntime", "onnx", "cv2", "mujoco", "rich")


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table of cells; write ``cost.json`` into ``out``."""
    base = yaml.safe_load(find_cell(Path("configs/surface_follow_sim.yaml")).read_text())
    base["task"]["distance_mm"] = 60
    far = json.loads(json.dumps(base))
    far["arms"]["arm"]["start_pose_mm_deg"][2] = 120
    far["task"].update(approach_distance_mm=60)
    true = json.loads(json.dumps(base))
    put_on_true_contact(true)
    with tempfile.TemporaryDirectory() as folder:
        write_simulated(Path(folder), _REPLAYED)
        rows = {
            "touchcell check": measure(base, "check"),
            "learned estimator": measure(base, "run"),
            "learned, never in contact": measure(far, "run"),
            "true contact, no images": measure(true, "run"),
            "learned, no simulator": measure(replaying(Path(folder) / IMAGE_FOLDER), "run"),
        }
    print(
        f"{'scene':<27}{'ready s':>9}{'CPU s':>7}{'memory MB':>11}{'peak MB':>9}{'cycle us':>10}{'sense us':>10}"
        "  heavy imports"
    )
    for name, row in rows.items():
        cycle, sense = row.get("cycle_us"), row.get("sense_us")
        print(
            f"{name:<27}{row['ready_s']:9.3f}{row['ready_cpu_s']:7.3f}{row['memory_mb']:11.1f}{row['peak_mb']:9.1f}"
            f"{'-' if cycle is None else f'{cycle:.0f}':>10}{'-' if sense is None else f'{sense:.0f}':>10}"
            f"  {', '.join(row['heavy']) or 'none'}"
        )
    (out / "cost.json").write_text(json.dumps({**provenance(), "scenes": rows}, indent=1) + "\n")


def replaying(images: Path) -> dict[str, Any]:
    """Return a cell that only replays camera frames from files: a process without simulation and motion."""
    estimator = {"kind": "network", "model": "builtin:sim_gdn"}
    return {
        "schema": 1,
        "name": "replaying",
        "time": "simulated",
        "rate_hz": 100,
        "sensors": {"sensor": {"driver": "replay_camera", "data": str(images), "rate_hz": 30, "estimator": estimator}},
        "task": {"name": "observe"},
    }


def measure(cell: dict[str, Any], what: str, starts: int = 3) -> dict[str, Any]:
    """Return the quickest of some starts of ``touchcell run`` or ``check``: the others waited for a busy machine."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(cell))
        rows: list[dict[str, Any]] = []
        for _ in range(starts):
            command = [sys.executable, "-c", _PROGRAM, str(path), what, ",".join(_HEAVY), str(time.monotonic_ns())]
            result = subprocess.run(command, capture_output=True, text=True, check=True, env=as_installed(Path(folder)))
            rows.append(json.loads(result.stdout.splitlines()[-1]))
    return min(rows, key=lambda row: float(row["ready_s"]))


_PROGRAM = """
import sys, time
path, what, heavy, spawned_ns = sys.argv[1:]
row = {}

def ready():
    row["ready_s"] = (time.monotonic_ns() - int(spawned_ns)) * 1e-9
    row["ready_cpu_s"] = time.process_time()

from pathlib import Path
if what == "run":
    from touchcell.cell.cli.run import trim_heap
    from touchcell.cell.runtime.black_box import BlackBox
    from touchcell.cell.runtime.compose import compose
    from touchcell.cell.config.schema import plan_cell
    from touchcell.cell.runtime.loop import RunLoop
    from touchcell.cell.recording.recorder import Recorder
    cell = compose(plan_cell(Path(path)))
    trim_heap()
    with Recorder(Path(path).with_name("run.mcap")) as recorder, cell:
        ready()
        times = RunLoop(cell, recorder, box=BlackBox()).run().times.rows
else:
    from touchcell.cell.config.schema import plan_cell
    plan_cell(Path(path))
    ready()
with open("/proc/self/status") as status:
    fields = dict(line.split(":", 1) for line in status)
row["memory_mb"], row["peak_mb"] = (int(fields[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))
row["heavy"] = sorted(set(heavy.split(",")) & set(sys.modules))
import json
if what == "run":
    import statistics
    row["cycle_us"] = statistics.median(times["cycle"]) * 1e-3
    row["sense_us"] = statistics.median(times["sense"]) * 1e-3
print(json.dumps(row))
"""
