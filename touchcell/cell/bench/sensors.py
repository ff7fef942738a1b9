"""``touchcell bench sensors``: several sensors in one cell in real time: age of their estimates, and starvation.

Cameras play recorded JPEG frames of 640x480 px, as fast as real ones and decoded when they are read. One control loop
at 100 Hz reads all of them. It either perceives in its own thread, as the product does, or reads the results of one
worker thread per sensor. An estimate's age is counted from the exposure of its frame until the loop has read it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.bench.quantiles import median_and_p99
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.sensor import Sensor
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.clock import Clock
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.pipeline import ContactSource
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.samples import contacts

_FRAMES = 60
_POLL_S = 0.5e-3
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
                for workers in (False, True):
                    row = measure(Path(folder), count, rate_hz, options.seconds, options.model, workers=workers)
                    rows.append(row)
                    print(_line(row), flush=True)
    print("ages of the worst sensor; late: cycles longer than their 10 ms; CPU: of one core")
    report = {**provenance(), "load_average": os.getloadavg()[0], "rows": rows}
    (out / "sensors.json").write_text(json.dumps(report, indent=1) + "\n")


def measure(frames: Path, sensors: int, rate_hz: float, seconds: float, model: str, *, workers: bool) -> dict[str, Any]:
    """Run one cell with that many sensors for that long; return a row of the table."""
    stop = StopRequest()
    fresh: dict[str, list[float]] = {}
    ages: dict[str, list[float]] = {}
    seen: dict[str, int] = {}
    with _cell(frames, sensors, rate_hz, model) as cell:
        started = [_threaded(sensor, cell.clock) for sensor in cell.sensors.values()] if workers else []

        def look(progress: Progress) -> None:
            now_ns = cell.clock.now_ns()
            if progress.t_s > seconds:
                stop.ask_at_once()
            for role, contact in progress.contacts.items():
                age_ms = 1e-6 * (now_ns - contact.t_frame_ns)
                if progress.t_s > _WARM_UP_S:
                    ages.setdefault(role, []).append(age_ms)
                    if seen.get(role) != contact.seq:
                        fresh.setdefault(role, []).append(age_ms)
                seen[role] = contact.seq

        cpu_s = time.process_time()
        result = RunLoop(cell, None, stop=stop, on_cycle=look).run()
        cpu_s = time.process_time() - cpu_s
        for worker in started:
            worker.finish()
    if result.error is not None:
        raise result.error
    measured_s = result.duration_s - _WARM_UP_S
    cycles_ms = 1e-6 * np.array(result.times.rows["cycle"])
    worst = max(fresh, key=lambda role: float(np.percentile(fresh[role], 99)))
    return {
        "sensors": sensors,
        "rate_hz": rate_hz,
        "workers": workers,
        "estimates_per_s": min(len(times) for times in fresh.values()) / measured_s,
        "new_age_ms": median_and_p99(fresh[worst]),
        "age_ms": median_and_p99(ages[worst]),
        "cycle_ms": median_and_p99(cycles_ms),
        "late": float((cycles_ms > 10.0).mean()),
        "cpu": cpu_s / result.duration_s,
    }


def _line(row: dict[str, Any]) -> str:
    where = "worker threads" if row["workers"] else "loop's thread"
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


def _cell(frames: Path, sensors: int, rate_hz: float, model: str) -> Cell:
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
        "sensors": {"sensor": camera},
        "task": {"name": "observe"},
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(description))
        cells = [compose(plan_cell(path)) for _ in range(sensors)]
    names = ["sensor", *(f"sensor {i}" for i in range(1, sensors))]
    return dataclasses.replace(
        cells[0],
        cameras={name: cell.cameras["sensor"] for name, cell in zip(names, cells, strict=True)},
        sensors={name: cell.sensors["sensor"] for name, cell in zip(names, cells, strict=True)},
    )


class _Worker(threading.Thread, ContactSource):
    """Perceives in its own thread, as soon as there is a frame; the loop reads the latest result."""

    def __init__(self, source: ContactSource, clock: Clock) -> None:
        super().__init__(daemon=True)
        self._source = source
        self._clock = clock
        self._finished = threading.Event()
        self._newest: ContactEstimate | None = None
        self._failure: BaseException | None = None

    @property
    def ended(self) -> bool:
        return self._source.ended

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        self._source.record_pose(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        if self._failure is not None:
            raise self._failure
        return self._newest

    def run(self) -> None:
        """Poll for a new frame every half millisecond."""
        try:
            while not self._finished.wait(_POLL_S):
                self._newest = self._source.update(self._clock.now_ns())
        except BaseException as error:
            self._failure = error

    def finish(self) -> None:
        """Stop, and wait for the end."""
        self._finished.set()
        self.join()


def _threaded(sensor: Sensor, clock: Clock) -> _Worker:
    worker = _Worker(sensor.source, clock)
    sensor.source = worker
    worker.start()
    return worker
