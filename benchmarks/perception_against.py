"""The marker estimator beside another checkout's: the same model and camera frames, processes by turns in one run.

CPU time of ``predict`` from a grey 640x480 frame unlike the one before, the fastest of several passes through them all,
and the time from a fresh process to its first estimate; and the networks' layers alone beside NumPy's BLAS. The other
checkout reads a copy of the model file without what its version does not know.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.bench.perception import camera_frame
from touchcell.cell.bench.provenance import as_installed, provenance
from touchcell.cell.bench.quantiles import median_and_p99
from touchcell.drivers.replay.dataset import read_split
from touchcell.perception.models.model_file import Model, load_model

_UNKNOWN: Final = ("session", "tail_scale", "transfer", "network_labels")
_SERVE: Final = """
import sys, time
spawned_ns = int(sys.argv[5])
import cv2, numpy as np
from pathlib import Path
cv2.setNumThreads(1)
try:
    from touchcell.perception.models.camera_frames import from_camera
    from touchcell.perception.models.model_file import load_model
    from touchcell.perception.markers.estimator import MarkerEstimator
except ModuleNotFoundError:
    from benchmarks.perception_serving import from_camera
    from perception.model_file import load_model
    from perception.marker_estimator import MarkerEstimator
import dataclasses
model = load_model(Path(sys.argv[1]))
chain = from_camera(model.header.preprocessing)
header = model.header.model_copy(update={"preprocessing": chain})
estimator = MarkerEstimator(dataclasses.replace(model, header=header))
frames = np.fromfile(sys.argv[2], np.uint8).reshape(int(sys.argv[3]), 480, 640)
estimator.predict(frames[0])
times = [(time.monotonic_ns() - spawned_ns, time.process_time_ns())]
for frame in [*frames] * 6:
    begun = time.process_time_ns()
    estimator.predict(frame)
    times.append((time.process_time_ns() - begun, 0))
np.save(sys.argv[4], np.array(times))
"""


def run(arguments: Sequence[str], out: Path) -> None:
    """Measure by turns, print, and write ``perception_against.json`` and ``.txt``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks perception-against")
    parser.add_argument("--against", type=Path, required=True, help="checkout with its own .venv")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True, help="marker model of that data")
    parser.add_argument("--split", default="val")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    out.mkdir(parents=True, exist_ok=True)
    split = read_split(options.data, options.split)
    chosen = np.random.default_rng(0).permutation(len(split.images))[: options.frames]
    images = dataclasses.replace(split, images=tuple(split.images[i] for i in chosen)).read()
    found: dict[str, list[dict[str, Any]]] = {"now": [], str(options.against): []}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        frames = scratch / "frames.raw"
        np.concatenate([camera_frame(image, i).ravel() for i, image in enumerate(images)]).tofile(frames)
        old = scratch / "old.safetensors"
        write_old(load_model(options.model), old)
        environment = as_installed(scratch)
        kinds = {
            "now": (sys.executable, options.model.resolve(), scratch),
            str(options.against): (str(options.against / ".venv/bin/python"), old, options.against),
        }
        for _ in range(options.rounds):
            for name, (python, model, place) in kinds.items():
                result = scratch / "times.npy"
                words = [str(model), str(frames), str(len(chosen)), str(result), str(time.monotonic_ns())]
                subprocess.run([python, "-c", _SERVE, *words], check=True, cwd=place, env=environment)
                times = np.load(result)
                # A busy machine only ever adds: each frame counts with the fastest of its passes.
                predict = median_and_p99(times[1:, 0].reshape(-1, len(chosen)).min(axis=0), 1e-6)
                started = {"start_s": float(times[0, 0]) * 1e-9, "start_cpu_s": float(times[0, 1]) * 1e-9}
                found[name].append({**predict, **started})
    lines = [
        f"{options.frames} frames, {options.rounds} rounds by turns; ms of CPU, median and p99; start to first estimate"
    ]
    for name, rows in found.items():
        cells = "   ".join(f"{row['median']:.2f} / {row['p99']:.2f}" for row in rows)
        lines.append(
            f"{name:<24}{cells}   start s (CPU s) "
            + " ".join(f"{r['start_s']:.2f} ({r['start_cpu_s']:.2f})" for r in rows)
        )
    now, other = (list(found.values())[i] for i in (0, 1))
    for key in ("median", "p99"):
        share = min(a[key] for a in now) / min(b[key] for b in other)
        lines.append(f"{key}: {share:.2f} of the other's")
    networks = beside_blas(load_model(options.model))
    lines.append("the networks' layers, us, 10 %, median and 90 % of 400, caches filled with other data before each:")
    lines += [f"  {name:<24}{low:.0f}   {middle:.0f}   {high:.0f}" for name, (low, middle, high) in networks.items()]
    print("\n".join(lines))
    (out / "perception_against.txt").write_text("\n".join(lines) + "\n")
    (out / "perception_against.json").write_text(
        json.dumps({"provenance": provenance(), "rows": found, "layers_us": networks}, indent=1) + "\n"
    )


def beside_blas(model: Model) -> dict[str, tuple[float, float, float]]:
    """Return the times of a marker model's layers, us: as the estimator computes them, and in BLAS in float32."""
    from touchcell.perception.kernels import HalfLayers

    count = sum(name.startswith("layer") and name.endswith("weight") for name in model.tensors)
    weights = [model.tensors[f"layer{i}.weight"] for i in range(count)]
    biases = [model.tensors[f"layer{i}.bias"][:, 0] for i in range(count)]
    halves = [HalfLayers(weight, bias) for weight, bias in zip(weights, biases, strict=True)]
    rng = np.random.default_rng(0)
    inputs = [rng.normal(size=weight.shape[:2]).astype(np.float32) for weight in weights]

    def ours() -> None:
        for layer, x in zip(halves, inputs, strict=True):
            layer(x)

    def blas() -> None:
        for weight, x in zip(weights, inputs, strict=True):
            for matrix, row in zip(weight, x, strict=True):
                np.dot(row, matrix)

    filled = np.zeros(4 << 20, np.uint8)
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "all")
    named = {"halves": ours, f"BLAS, threads: {threads}": blas}
    times: dict[str, list[int]] = {name: [] for name in named}
    for turn in range(400):
        for name, call in named.items():
            filled.fill(turn % 256)
            begun = time.perf_counter_ns()
            call()
            times[name].append(time.perf_counter_ns() - begun)
    return {
        name: (float(low), float(middle), float(high))
        for name, (low, middle, high) in ((n, 1e-3 * np.percentile(t, [10, 50, 90])) for n, t in times.items())
    }


def write_old(model: Model, path: Path) -> None:
    """Write a model without what version 0.1.0 does not read."""
    from safetensors.numpy import save

    header = model.header.model_dump(mode="json", exclude=set(_UNKNOWN))
    header["architecture"].pop("camera_check", None)
    tensors = {name: each for name, each in model.tensors.items() if not name.startswith("camera.")}
    path.write_bytes(save(tensors, metadata={"touchcell": json.dumps(header)}))
