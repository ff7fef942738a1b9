"""``touchcell bench perception``: every estimator in every runtime, run time and memory against error and calibration.

Each estimator runs in a fresh process for each runtime: its memory, the time until its first estimate, and the time
per 640x480 grey frame on one thread are its own. Images that are published after cropping and thresholding are pasted
back into camera frames for that, so that the whole chain of a cell is timed; errors are those on the published images.
Without ``--data``, the shipped model and simulated camera frames are measured.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchcell.cell.bench import perception_figures
from touchcell.cell.bench.perception_bands import PROBABILITIES, band_lines, summaries, write_reliability_by_band
from touchcell.cell.bench.perception_runtimes import by_turns, installed
from touchcell.cell.bench.perception_serving import OWN
from touchcell.cell.bench.perception_validity import validity, validity_lines
from touchcell.cell.bench.provenance import as_installed, provenance
from touchcell.cell.bench.quantiles import median_and_p99
from touchcell.drivers.replay.dataset import IMAGE_COLUMN, IMAGE_FOLDER, LABEL_COLUMNS, LABEL_FILES, read_split
from touchcell.geometry import se3
from touchcell.geometry.types import ImageArray
from touchcell.paths import MODELS
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.camera_frames import FRAME_SIZE, from_camera
from touchcell.perception.models.model_file import Header, load_model
from touchcell.perception.networks.figures import write_predictions
from touchcell.perception.networks.scores import SCORE_NAMES, Scores
from touchcell.simulation.render import FrameRenderer, Lighting
from touchcell.simulation.samples import USUAL_VARIATION, contacts

SHIPPED = MODELS / "sim_gdn.safetensors"
_PARTS = {
    "all": "all images",
    "slip_free": "shear below 0.6 of the depth",
    "slipping": "the others, with slip",
    "camera": "the timed frames: images pasted back into camera frames, where they were cropped",
}


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the tables; write ``perception.json``, ``perception.txt`` and the plots into ``out``.

    Raises:
        DataError, ModelError, ImageError: the data set or a model cannot be used.
    """
    options = _options(arguments)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        if options.data is None:
            options.data = Path(scratch)
            write_simulated(options.data / options.split, options.images)
            about = f"{options.images} simulated camera frames and the shipped model; --data measures real images"
        else:
            about = f"{options.data}, split {options.split}"
        rows, scores = _measured(options, Path(scratch))
        changed = _changed(options)
    turns = {
        path.stem: by_turns(model, options.runtimes, options.frames)
        for path in options.models
        if isinstance((model := load_model(path)).header.architecture, Architecture)
    }
    by_band = {name: summaries(each) for name, each in scores.items()}
    bands = (line for name, found in by_band.items() for line in band_lines(name, found))
    text = "\n".join([about, table(rows), *_turn_lines(turns), *bands, *validity_lines(changed)])
    print(text)
    (out / "perception.txt").write_text(text + "\n")
    report = {
        "provenance": provenance(),
        "about": about,
        "probabilities": PROBABILITIES,
        "rows": rows,
        "by_turns": turns,
        "bands": by_band,
        "validity": changed,
    }
    (out / "perception.json").write_text(json.dumps(report, indent=1) + "\n")
    perception_figures.write_run_time_against_error(out / "perception.png", rows)
    perception_figures.write_reliability(out / "perception_reliability.png", PROBABILITIES, rows)
    for name, each in scores.items():
        picture = out / f"perception_reliability_{name}.png"
        write_reliability_by_band(picture, f"{name}, by depth and slip", by_band[name])
        write_predictions(
            out / f"perception_{name}.png",
            truth=each.contact_mm_deg,
            predicted=each.predicted_mm_deg,
            sigma=np.sqrt(np.diagonal(each.covariance, axis1=1, axis2=2)),
        )
    print(f"\nwritten: {', '.join(sorted(str(path) for path in out.glob('perception*')))}")


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("touchcell bench perception --", description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, help="data set folder; without it, simulated images")
    parser.add_argument("--split", default="val", help="train, val or test")
    parser.add_argument("--models", type=Path, nargs="+", help="model files (default: models/*.safetensors)")
    parser.add_argument("--runtimes", nargs="+", choices=installed(), default=installed())
    parser.add_argument("--frames", type=int, default=400, help="camera frames that are timed")
    parser.add_argument("--images", type=int, default=400, help="how many are simulated without --data")
    parser.add_argument("--changed", type=int, default=50, help="frames to which each change of the image is applied")
    options = parser.parse_args(arguments)
    if options.models is None:
        options.models = [SHIPPED] if options.data is None else sorted(Path("models").glob("*.safetensors"))
    if not options.models:
        parser.error("there are no models/*.safetensors: name model files with --models")
    return options


def _measured(options: argparse.Namespace, scratch: Path) -> tuple[list[dict[str, Any]], dict[str, Scores]]:
    """Return one row for each estimator and runtime, and each estimator's scores in the first of its runtimes."""
    labels = read_split(options.data, options.split).contact_mm_deg
    headers = {path: load_model(path).header for path in options.models}
    served, shown = _frames(options, headers)
    frames = scratch / "frames.raw"
    np.concatenate([image.ravel() for image in served]).tofile(frames)
    rows: list[dict[str, Any]] = []
    scores: dict[str, Scores] = {}
    for path, header in headers.items():
        runtimes = options.runtimes if isinstance(header.architecture, Architecture) else [OWN]
        for runtime in runtimes:
            print(f"{path.stem} in {runtime}", file=sys.stderr, flush=True)
            result = scratch / "result.npz"
            program = [sys.executable, "-m", "touchcell.cell.bench.perception_serving"]
            words = list(map(str, [path, runtime, frames, len(served), options.data, options.split, result]))
            environment = as_installed(scratch)
            # Modules are byte-compiled once, before anything is measured.
            subprocess.run([*program, *words, "0", "--start-only"], check=True, env=environment)
            subprocess.run([*program, *words, str(time.monotonic_ns())], check=True, env=environment)
            with np.load(result) as found:
                each, camera = (
                    Scores(
                        labels[which],
                        found[f"{kind}xi"],
                        found[f"{kind}covariance"],
                        found[f"{kind}in_range"],
                        _tail(found, kind),
                    )
                    for kind, which in (("", slice(None)), ("served_", shown))
                )
                figures = json.loads(str(found["figures"]))
                times = {
                    "latency_ms": _quantiles(found["other_frame_ns"]),
                    "again_ms": _quantiles(found["same_frame_ns"]),
                }
            scores.setdefault(path.stem, each)
            first = scores[path.stem]
            rows.append(
                {
                    "estimator": path.stem,
                    "kind": header.architecture.kind,
                    "runtime": runtime,
                    **times,
                    **figures,
                    "training_s": header.training.get("epochs_cpu_s"),
                    "all": _scored(each),
                    "slip_free": _scored(each.subset(each.slip_free)),
                    "slipping": _scored(each.subset(~each.slip_free)),
                    "camera": _scored(camera),
                    "in_range": float(each.in_range.mean()),
                    "joint_coverage": {"68": each.joint_coverage(0.68), "95": each.joint_coverage(0.95)},
                    "reliability": each.reliability(PROBABILITIES),
                    "apart_from_first_runtime": float(np.abs(each.xi - first.xi).max()),
                }
            )
    return rows, scores


def _tail(found: Mapping[str, np.ndarray], kind: str) -> float | None:
    scale = float(found[f"{kind}tail_scale"])
    return None if np.isnan(scale) else scale


def _changed(options: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Return what each model accepts of changed camera frames."""
    split = read_split(options.data, options.split)
    chosen = np.linspace(0, len(split.images) - 1, min(options.changed, len(split.images))).astype(int)
    images = dataclasses.replace(split, images=tuple(split.images[i] for i in chosen)).read()
    frames = [camera_frame(image, int(i)) for i, image in zip(chosen, images, strict=True)]
    found = {}
    for path in options.models:
        print(f"{path.stem} on changed frames", file=sys.stderr, flush=True)
        found[path.stem] = validity(path, frames, split.contact_mm_deg[chosen])
    return found


def _scored(scores: Scores) -> dict[str, Any]:
    if not len(scores):
        return {"n": 0}
    return {
        "n": len(scores),
        "mae": scores.mae(),
        "nll": float(scores.nll.mean()),
        "coverage": {"68": scores.coverage(0.68), "95": scores.coverage(0.95)},
    }


def _quantiles(times_ns: np.ndarray) -> dict[str, dict[str, float]]:
    return {clock: median_and_p99(times_ns[:, column], 1e-6) for column, clock in enumerate(("wall", "cpu"))}


def _frames(options: argparse.Namespace, headers: Mapping[Path, Header]) -> tuple[list[ImageArray], list[int]]:
    """Return camera frames of images spread over the split, and their indices."""
    split = read_split(options.data, options.split)
    step = max(1, len(split.images) // options.frames)
    sizes = {from_camera(header.preprocessing).input_size for header in headers.values()}
    shown = list(range(0, len(split.images), step))[: options.frames]
    chosen = dataclasses.replace(split, images=tuple(split.images[i] for i in shown))
    frames = [camera_frame(image, i) if sizes == {FRAME_SIZE} else image for i, image in enumerate(chosen.read())]
    return frames, shown


def camera_frame(image: ImageArray, seed: int) -> ImageArray:
    """Return a thresholded image as a camera frame: in the centre of a grey 640x480 frame.

    Camera frames are unchanged.
    """
    height, width = image.shape
    if (height, width) == FRAME_SIZE:
        return image
    light = Lighting()
    frame = np.full(FRAME_SIZE, light.background)
    top, left = (FRAME_SIZE[0] - height) // 2, (FRAME_SIZE[1] - width) // 2
    soft = cv2.GaussianBlur(image, (0, 0), 0.8) / 255.0
    frame[top : top + height, left : left + width] += (light.pin - light.background) * soft
    frame += np.random.default_rng(seed).normal(0.0, light.noise, FRAME_SIZE)
    return np.clip(np.round(frame), 0, 255).astype(np.uint8)


def write_simulated(folder: Path, images: int, seed: int = 0) -> None:
    """Write a split of simulated grey camera frames, in the layout of the public data sets."""
    (folder / IMAGE_FOLDER).mkdir(parents=True)
    renderer = FrameRenderer(seed=seed)
    with (folder / LABEL_FILES[0]).open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow([IMAGE_COLUMN, *LABEL_COLUMNS])
        for i, contact in enumerate(contacts(images, seed, variation=USUAL_VARIATION)):
            name = f"image_{i + 1}.png"
            cv2.imwrite(str(folder / IMAGE_FOLDER / name), renderer.raw(contact.pixels, i))
            rows.writerow([name, *se3.to_euler_mm_deg(contact.T_f_s).tolist()])


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format the measured rows as text."""
    return "\n".join([*_error_lines(rows), "", *_cost_lines(rows), *_stage_lines(rows)])


def _error_lines(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    first = {row["estimator"]: row for row in reversed(rows)}
    width = max(22, 2 + max(map(len, first)))
    yield f"{'':<{width}}{'images':>7}" + "".join(f"{name:>11}" for name in SCORE_NAMES) + f"{'NLL':>8}"
    for part, title in _PARTS.items():
        yield f"{title}: MAE (within 68 %, 95 %)"
        for name, row in reversed(first.items()):
            figures = row[part]
            if figures["n"] == 0:
                continue
            yield (
                f"  {name:<{width - 2}}{figures['n']:>7}"
                + "".join(f"{figures['mae'][component]:>11.3f}" for component in SCORE_NAMES)
                + f"{figures['nll']:>8.2f}"
            )
            for percent in ("68", "95"):
                fractions = figures["coverage"][percent]
                yield f"  {'':<{width + 5}}" + "".join(f"{100 * fractions[c]:>9.1f} %" for c in SCORE_NAMES)


def _cost_lines(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield "one thread, grey 640x480 frames that differ from the previous one; ms of CPU and wall time, median and p99"
    yield (
        f"{'':<22}{'runtime':<13}{'CPU':>7}{'p99':>7}{'wall':>7}{'p99':>7}{'again':>7}{'start s':>9}{'CPU s':>7}"
        f"{'MB':>7}{'peak':>7}{'training CPU s':>16}{'apart':>10}"
    )
    for row in rows:
        cpu, wall = row["latency_ms"]["cpu"], row["latency_ms"]["wall"]
        training = "-" if row["training_s"] is None else f"{row['training_s']:.0f}"
        yield (
            f"{row['estimator']:<22}{row['runtime']:<13}{cpu['median']:>7.2f}{cpu['p99']:>7.2f}{wall['median']:>7.2f}"
            f"{wall['p99']:>7.2f}{row['again_ms']['cpu']['median']:>7.2f}{row['start_s']:>9.2f}{row['start_cpu_s']:>7.2f}{row['memory_mb']:>7.0f}"
            f"{row['peak_mb']:>7.0f}{training:>16}{row['apart_from_first_runtime']:>10.1e}"
        )
    yield "again: the same frame once more, CPU; start: from a fresh process to its first estimate, wall and CPU;"
    yield "apart: largest difference from the xi of the estimator's first runtime, m or rad;"
    yield "training: CPU time of all epochs, where the model file has it; decoding and matching come on top"


def _stage_lines(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    names = list(dict.fromkeys(name for row in rows for name in row["stages_ms"]))
    yield "\nby stage, frames that differ from the previous ones; ms CPU, median and p99"
    yield f"{'':<22}{'runtime':<13}" + "".join(f"{name:>16}" for name in names)
    for row in rows:
        stages = row["stages_ms"]
        cells = (f"{stages[n]['median']:>9.2f}{stages[n]['p99']:>7.2f}" if n in stages else f"{'-':>16}" for n in names)
        yield f"{row['estimator']:<22}{row['runtime']:<13}" + "".join(cells)


def _turn_lines(turns: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Iterator[str]:
    if turns:
        yield "\nthe network alone, runtimes by turns in one process; ms CPU, median and p99"
    for name, row in turns.items():
        cells = "".join(f"{runtime:>14} {times['median']:.2f} / {times['p99']:.2f}" for runtime, times in row.items())
        yield f"{name:<22}{cells}"
