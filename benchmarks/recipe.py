"""The recipe of docs/how-to/recipe.md from zero, with unlike sensors: collect, train, evaluate, and follow a surface.

Each step is the command of the recipe in a process of its own. The sensors are simulated: the default one, the one
fitted to real images, one of nine rings whose camera is turned by 150 deg, and one whose camera sees the skin in a
mirror. None of their models ships.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from touchcell.cell.bench.provenance import provenance
from touchcell.perception.models.labels import CONTACT_NAMES
from touchcell.progress import shown_progress
from touchcell.simulation.tip_file import SHIPPED

_FRANKA: Final = "franka_tactip_1"
_CHANGED: Final = {
    "turned": {"rings": 9, "ring_step_rad": 0.138, "image_rotation_rad": 2.6, "rim_follow": 0.1, "follow": 0.9},
    "mirrored": {"mirrored": True, "rings": 8, "ring_step_rad": 0.155, "image_rotation_rad": -2.0, "follow": 0.9},
}
_SENSORS: Final = ("default", _FRANKA, *_CHANGED)
_NAN: Final = float("nan")
_STEPS: Final = ("collect", "train", "evaluate", "follow")


@dataclass(frozen=True, slots=True)
class Walked:
    """The recipe with one sensor.

    Attributes:
        sensor: which one.
        outcome: of the last step, or what ended an earlier one.
        mae: of x, y, z in mm and alpha, beta, gamma in degrees, on validation images.
        depth_rms_mm, tilt_rms_deg: of the estimate while following the surface.
        seconds: of each step.
    """

    sensor: str
    outcome: str
    mae: tuple[float, ...]
    depth_rms_mm: float
    tilt_rms_deg: float
    seconds: tuple[float, ...]


def run(arguments: Sequence[str], out: Path) -> None:
    """Walk the recipe and print how each sensor's cell ends."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks recipe")
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--sensors", nargs="+", choices=_SENSORS, default=list(_SENSORS))
    options = parser.parse_args(arguments)
    out.mkdir(parents=True, exist_ok=True)
    walked = []
    with tempfile.TemporaryDirectory() as folder, shown_progress() as show:
        for sensor in options.sensors:
            place = Path(folder) / sensor
            place.mkdir()
            walked.append(_walk(place, sensor, options.samples, show))
    lines = ["sensor            outcome        z mm  tilt deg  following: depth RMS mm  tilt RMS deg  minutes"]
    lines += [
        f"{each.sensor:<17} {each.outcome:<12} {each.mae[2]:6.3f}  {max(each.mae[3:5]):8.2f}  {each.depth_rms_mm:23.3f}"
        f"  {each.tilt_rms_deg:12.2f}  {sum(each.seconds) / 60:7.1f}"
        for each in walked
    ]
    text = "\n".join([f"{options.samples} samples, three in four to train", *lines])
    print(text)
    result = {"provenance": provenance(), "samples": options.samples, "sensors": [asdict(each) for each in walked]}
    (out / "recipe.json").write_text(json.dumps(result, indent=1))
    (out / "recipe.txt").write_text(text + "\n")


def _walk(folder: Path, sensor: str, samples: int, show: Any) -> Walked:
    seconds: list[float] = []
    mae: tuple[float, ...] = (_NAN,) * 6
    truth = _tip(folder, sensor)
    collect = _cell(folder, "collect", "collect_sim.yaml", truth)
    collect["sensors"]["sensor"].pop("output", None)
    collect["task"]["samples"] = samples
    follow = _cell(folder, "follow", "surface_follow_sim.yaml", truth)
    follow["sensors"]["sensor"]["estimator"]["model"] = "mine.safetensors"
    for name, cell in (("collect", collect), ("follow", follow)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(cell, sort_keys=False))
    commands = (
        ["run", "collect.yaml", "--data", "collected", "--quiet"],
        ["train", "--kind", "markers", "--networks", "1", "--data", "collected", "--out", "mine.safetensors"],
        ["evaluate", "--data", "collected", "--split", "val", "--model", "mine.safetensors", "--json", "scores.json"],
        ["run", "follow.yaml", "--out", "followed", "--quiet"],
    )
    for number, (step, command) in enumerate(zip(_STEPS, commands, strict=True)):
        show(sensor, number, len(commands), step)
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "touchcell", *command], cwd=folder, capture_output=True, text=True, check=False
        )
        seconds.append(time.perf_counter() - begun)
        if step == "evaluate" and done.returncode == 0:
            mae = tuple(json.loads((folder / "scores.json").read_text())["mae"][name] for name in CONTACT_NAMES)
        if done.returncode != 0:
            reason = (done.stderr or done.stdout).strip().splitlines()[-1]
            print(f"{sensor}: {step}: {reason}", file=sys.stderr)
            return Walked(sensor, f"{step} ended with {done.returncode}", mae, _NAN, _NAN, tuple(seconds))
    row = re.search(r"estimate - true +(.*)", done.stdout)
    errors = [float(value) for value in row[1].split()] if row else [_NAN] * 6
    return Walked(sensor, "done", mae, errors[2], max(errors[3:5]), tuple(seconds))


def _cell(folder: Path, name: str, shipped: str, tip: str | None) -> dict[str, Any]:
    command = [sys.executable, "-m", "touchcell", "new", "cell", name, "--from", shipped]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    cell: dict[str, Any] = yaml.safe_load((folder / f"{name}.yaml").read_text())
    if tip is not None:
        cell["sensors"]["sensor"]["tip"] = tip
    return cell


def _tip(folder: Path, sensor: str) -> str | None:
    """Return the value of ``tip:`` of a sensor; None for the default one."""
    if sensor not in _CHANGED:
        return None if sensor == "default" else sensor
    tip: dict[str, Any] = yaml.safe_load((SHIPPED / f"{_FRANKA}.yaml").read_text())
    tip["tip"] |= _CHANGED[sensor]
    (folder / f"{sensor}.yaml").write_text(yaml.safe_dump(tip, sort_keys=False))
    return f"{sensor}.yaml"
