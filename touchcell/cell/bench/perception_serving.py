"""One estimator in one runtime in its own process, as started by ``touchcell bench perception``.

Run as ``python -m touchcell.cell.bench.perception_serving MODEL RUNTIME FRAMES COUNT DATA SPLIT RESULT SPAWNED_NS
[--start-only]``.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from touchcell.cell.bench.quantiles import median_and_p99
from touchcell.geometry.types import ImageArray
from touchcell.perception.markers.estimator import MarkerEstimator
from touchcell.perception.models.camera_frames import from_camera
from touchcell.perception.models.model_file import Model, load_model
from touchcell.perception.models.prediction import ContactEstimator, Prediction
from touchcell.perception.runtime.estimators import estimator_of
from touchcell.perception.runtime.inference import ContactModel

T = TypeVar("T")

OWN = "own"
"""Runtime of an estimator that is not a single network: the product's own."""


def main(arguments: list[str]) -> None:
    """Serve frames, then every image of a split, and write the figures to RESULT (.npz).

    MODEL is a model file, RUNTIME one of ``perception_runtimes.RUNTIMES`` or ``OWN``, FRAMES a file of COUNT raw grey
    frames, DATA and SPLIT a data set, SPAWNED_NS the time.monotonic_ns() at which the process was started. With
    ``--start-only`` it ends after its first estimate.
    """
    model_path, runtime, frames_path, count, data, split, result, spawned_ns, *start_only = arguments
    cv2.setNumThreads(1)
    model = load_model(Path(model_path))
    taught = model.header.preprocessing
    preprocessing = from_camera(taught)
    header = model.header.model_copy(update={"preprocessing": preprocessing})
    estimator = _estimator(dataclasses.replace(model, header=header), runtime)
    del model
    frames = _Frames(Path(frames_path), preprocessing.input_size, int(count))
    estimator.predict(frames.read(0))
    started_s = (time.monotonic_ns() - int(spawned_ns)) * 1e-9
    figures: dict[str, Any] = {"start_s": started_s, "start_cpu_s": time.process_time()}
    if start_only:
        return
    other, again = _latency(estimator, frames)
    figures |= {"memory_mb": _memory_mb("VmRSS"), "peak_mb": _memory_mb("VmHWM")}
    figures["stages_ms"] = _stages(estimator, frames)
    served = [estimator.predict(frames.read(i)) for i in range(frames.count)]

    from touchcell.drivers.replay.dataset import read_split

    estimator = _estimator(load_model(Path(model_path)), runtime)
    predictions = [estimator.predict(image) for image in read_split(Path(data), split).read()]
    np.savez(
        result,
        figures=np.array(json.dumps(figures)),
        other_frame_ns=other,
        same_frame_ns=again,
        **_arrays("served_", served),
        **_arrays("", predictions),
    )


def _arrays(prefix: str, predictions: Sequence[Prediction]) -> dict[str, Any]:
    return {
        f"{prefix}xi": np.stack([prediction.xi for prediction in predictions]),
        f"{prefix}covariance": np.stack([prediction.covariance for prediction in predictions]),
        f"{prefix}in_range": np.array([prediction.in_range for prediction in predictions]),
        f"{prefix}tail_scale": np.array(predictions[0].tail_scale or np.nan),
    }


class _Frames:
    """Frames in a file, read one by one, so that they do not count as the estimator's memory."""

    def __init__(self, path: Path, size: tuple[int, int], count: int) -> None:
        self._path, self._size, self.count = path, size, count

    def read(self, i: int) -> ImageArray:
        pixels = self._size[0] * self._size[1]
        return np.fromfile(self._path, np.uint8, pixels, offset=i * pixels).reshape(self._size)


def _estimator(model: Model, runtime: str) -> ContactEstimator:
    if runtime == OWN:
        return estimator_of(model)
    from touchcell.cell.bench.perception_runtimes import RUNTIMES

    return ContactModel(model, RUNTIMES[runtime](model))


def _latency(estimator: ContactEstimator, frames: _Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 2) nanoseconds of wall and CPU time, for a new frame and for its repetition."""
    times: list[list[tuple[int, int]]] = [[], []]
    for i in range(frames.count):
        image = frames.read(i)
        for row in times:
            cpu_ns, wall_ns = time.process_time_ns(), time.perf_counter_ns()
            estimator.predict(image)
            row.append((time.perf_counter_ns() - wall_ns, time.process_time_ns() - cpu_ns))
    return np.array(times[0]), np.array(times[1])


def _stages(estimator: ContactEstimator, frames: _Frames) -> dict[str, dict[str, float]]:
    """Return the CPU time in ms, median and p99, of the steps of ``predict``, for new frames."""
    times: dict[str, list[int]] = {}

    def timed(name: str, step: Callable[..., T], *arguments: Any) -> T:
        start_ns = time.process_time_ns()
        result = step(*arguments)
        times.setdefault(name, []).append(time.process_time_ns() - start_ns)
        return result

    for i in range(frames.count):
        reduced = timed("preprocessing", estimator.reduce, frames.read(i))
        if isinstance(estimator, MarkerEstimator):
            discs = timed("discs", estimator.find, reduced)
            field = timed("matching", estimator.match, discs)
            mean, sigma = timed("network", estimator.infer, field)
            timed("Gaussian", estimator.decode, field, mean, sigma)
        elif isinstance(estimator, ContactModel):
            outputs = timed("network", estimator.infer, reduced)
            timed("Gaussian", estimator.decode, outputs)
    return {name: median_and_p99(row, 1e-6) for name, row in times.items()}


def _memory_mb(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith(f"{field}:")).split()[1]) / 1024.0


if __name__ == "__main__":
    main(sys.argv[1:])
