"""``touchcell bench sensors``: several sensors in one cell in real time: age of their estimates, and starvation.

Cameras play recorded JPEG frames of 640x480 px, as fast as real ones and decoded when they are read. One control loop
at 100 Hz reads all of them. Each case is measured with every value of the cell's ``perceive_in``: in the loop's thread,
in a thread for each sensor, and as a cell does that says nothing. An estimate's age is counted from the exposure of its
frame until the loop has read it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.bench.quantiles import median_and_p99
from touchcell.cell.config.perception_threads import threaded_sensors
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.samples import contacts

_FRAMES = 60
_WARM_UP_S = 0.5


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``sensors.json`` into ``out``."""
    parser = argparse.ArgumentParser("touchcell bench sensors --", description=__doc__.partition("\n")[0])
    parser.add_argument("--sensors", type=int, nargs="+", default=[1, 2], help="how many")
    parser.add_argument("--rates", type=float, nargs="+", default=[30.0, 60.0], help="frames per second of each")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    parser.add_argument("--model", default="builtin:sim_gdn", help="model file that takes 640x480 frames")
    options = parser.parse_args(arguments)
    print(
        f"{'sensors':>7}{'Hz':>6} {'perceived in':<15}{'estimates/s':>12}{'age ms, new':>13}{'p99':>7}"
        f"{'any':>7}{'p99':>7}"
        f"{'cycle ms':>10}{'p99':>7}{'late':>8}{'CPU':>7}"
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        _write_frames(Path(folder), round(options.seconds * max(options.rates)) + 1)
        for count in options.sensors:
            for rate_hz in options.rates:
                for where in ("loop", "threads", "auto"):
                    row = measure(Path(folder), count, rate_hz, options.seconds, options.model, where)
                    rows.append(row)
                    print(_line(row), flush=True)
    print("ages of the worst sensor; late: cycles longer than their 10 ms; CPU: of one core")
    report = {**provenance(), "load_average": os.getloadavg()[0], "rows": rows}
    (out / "sensors.json").write_text(json.dumps(report, indent=1) + "\n")


def measure(frames: Path, sensors: int, rate_hz: float, seconds: float, model: str, where: str) -> dict[str, Any]:
    """Run one cell with that many sensors, and that ``perceive_in``, for that long; return a row of the table."""
    stop = StopRequest()
    fresh: dict[str, list[tuple[float, float]]] = {}
    ages: dict[str, list[tuple[float, float]]] = {}
    seen: dict[str, int] = {}
    with _cell(frames, sensors, rate_hz, model, where) as cell:
        threaded = any(sensor.threaded for sensor in cell.sensors.values())

        def look(progress: Progress) -> None:
            now_ns = cell.clock.now_ns()
            if progress.t_s > seconds:
                stop.ask_at_once()
            for role, contact in progress.contacts.items():
                found = progress.t_s, 1e-6 * (now_ns - contact.t_frame_ns)
                ages.setdefault(role, []).append(found)
                if seen.get(role) != contact.seq:
                    fresh.setdefault(role, []).append(found)
                seen[role] = contact.seq

        cpu_s = time.process_time()
        result = RunLoop(cell, None, stop=stop, on_cycle=look).run()
        cpu_s = time.process_time() - cpu_s
    if result.error is not None:
        raise result.error
    cycles_ms = 1e-6 * np.array(result.times.rows["cycle"])
    new_ms = {role: _measured(each) for role, each in fresh.items()}
    worst = max(new_ms, key=lambda role: float(np.percentile(new_ms[role], 99)))
    return {
        "sensors": sensors,
        "rate_hz": rate_hz,
        "perceive_in": where,
        "threads": threaded,
        "estimates_per_s": min(map(len, fresh.values())) / result.duration_s,
        "new_age_ms": median_and_p99(new_ms[worst]),
        "age_ms": median_and_p99(_measured(ages[worst])),
        "cycle_ms": median_and_p99(cycles_ms),
        "late": float((cycles_ms > 10.0).mean()),
        "cpu": cpu_s / result.duration_s,
    }


def _measured(found: list[tuple[float, float]]) -> list[float]:
    """Return what was measured after the first half second; all of it where the machine stood still afterwards."""
    return [value for t_s, value in found if t_s > _WARM_UP_S] or [value for _, value in found]


def _line(row: dict[str, Any]) -> str:
    where = row["perceive_in"]
    if where == "auto":
        where += ", threads" if row["threads"] else ", loop"
    new, age, cycle = row["new_age_ms"], row["age_ms"], row["cycle_ms"]
    return (
        f"{row['sensors']:>7}{row['rate_hz']:>6.0f} {where:<15}{row['estimates_per_s']:>12.1f}{new['median']:>13.1f}"
        f"{new['p99']:>7.1f}{age['median']:>7.1f}{age['p99']:>7.1f}{cycle['median']:>10.2f}{cycle['p99']:>7.2f}"
        f"{100 * row['late']:>6.1f} %{100 * row['cpu']:>5.0f} %"
    )


def _write_frames(folder: Path, n: int) -> None:
    """Write JPEG camera frames of simulated contacts; the same few repeatedly."""
    renderer = FrameRenderer()
    kinds = [
        cv2.imencode(".jpg", renderer.raw(contact.pixels, i))[1].tobytes()
        for i, contact in enumerate(contacts(_FRAMES, 0))
    ]
    for i in range(n):
        (folder / f"frame_{i}.jpg").write_bytes(kinds[i % len(kinds)])


def _cell(frames: Path, sensors: int, rate_hz: float, model: str, where: str) -> Cell:
    """Return an observing cell with any number of sensors: more than its task asks for."""
    estimator = {
        "kind": "network",
        "model": model,
        "filter": {"drift_mm_per_sqrt_s": 1.5, "drift_deg_per_sqrt_s": 6.0},
    }
    camera = {"driver": "replay_camera", "data": str(frames), "rate_hz": rate_hz, "estimator": estimator}
    description = {
        "schema": 1,
        "name": "sensors",
        "time": "real",
        "rate_hz": 100,
        "perceive_in": where,
        "sensors": {"sensor": camera},
        "task": {"name": "observe"},
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(description))
        plan = plan_cell(path)
        cells = [compose(plan) for _ in range(sensors)]
    names = ["sensor", *(f"sensor {i}" for i in range(1, sensors))]
    section, device = plan.cell.sensors["sensor"], plan.sensors["sensor"]
    together = plan.cell.model_copy(update={"sensors": dict.fromkeys(names, section)})
    threaded = threaded_sensors(together, dict.fromkeys(names, device))
    for name, cell in zip(names, cells, strict=True):
        cell.sensors["sensor"].threaded = name in threaded
    return dataclasses.replace(
        cells[0],
        cameras={name: cell.cameras["sensor"] for name, cell in zip(names, cells, strict=True)},
        sensors={name: cell.sensors["sensor"] for name, cell in zip(names, cells, strict=True)},
    )
