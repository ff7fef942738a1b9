"""``touchcell bench following``: surface following and tracking in simulation, estimation and control error apart.

The cells that ship run with the learned estimator and again on the true contact: over the ramp, along the paper's eight
paths over the dome, and behind a plate that moves in all six components. All errors are of the true contact against
the reference while the task runs, so the second column is what control alone leaves.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.provenance import provenance
from cell.cli import find_cell
from cell.compose import compose
from cell.config import plan_cell
from cell.loop import RunLoop
from cell.messages import COMPONENTS
from cell.recording import Recorder
from cell.report import load_run, summarise

_DIRECTIONS_DEG = (0, 45, 90, 135, 180, 225, 270, 315)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; writes ``following.json`` and ``following.png`` into ``out``."""
    rows: dict[str, dict[str, Any]] = {}
    scenes = {"ramp": _cell("surface_follow_sim.yaml")}
    for direction_deg in _DIRECTIONS_DEG:
        dome = _cell("surface_follow_dome_sim.yaml")
        dome["task"]["direction_deg"] = direction_deg
        scenes[f"dome {direction_deg} deg"] = dome
    scenes["moving plate"] = _cell("object_track_sim.yaml")
    print(
        f"{'RMS error':<16}{'estimator':<14}" + "".join(f"{name:>11}" for name in COMPONENTS) + f"{'x real time':>13}"
    )
    for name, cell in scenes.items():
        for estimator in ("learned", "true contact"):
            if estimator == "true contact":
                cell["sensors"]["sensor"]["estimator"] = {"kind": "true_contact"}
            row = _measure(cell, out)
            rows[f"{name}, {estimator}"] = row
            cells = "".join(f"{row['rms'][c]:11.3f}" if c in row["rms"] else f"{'-':>11}" for c in COMPONENTS)
            print(f"{name:<16}{estimator:<14}{cells}{row['times_real_time']:13.1f}", flush=True)
    (out / "following.json").write_text(json.dumps({**provenance(), "runs": rows}, indent=1) + "\n")
    _plot(rows, out / "following.png")


def _cell(name: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(find_cell(Path("configs") / name).read_text())
    return data


def _measure(cell_file: dict[str, Any], out: Path) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(dir=out) as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(cell_file))
        cell = compose(plan_cell(path))
        started = time.perf_counter()
        with Recorder(Path(folder) / "run.mcap") as recorder, cell:
            result = RunLoop(cell, recorder).run()
        wall_s = time.perf_counter() - started
        errors = summarise(load_run(Path(folder) / "run.mcap"))["errors"]["sensor"]
    return {
        "outcome": result.outcome.value,
        "rms": errors["control"]["rms"],
        "estimation_rms": errors["estimation"]["rms"],
        "times_real_time": result.duration_s / wall_s,
    }


def _plot(rows: dict[str, dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    scenes = list(dict.fromkeys(name.rpartition(", ")[0] for name in rows))
    figure, axes = plt.subplots(1, 2, figsize=(13, 4.5), layout="constrained")
    position = np.arange(len(scenes))
    for axis, (components, title) in zip(
        axes, ((("z_mm",), "depth (mm)"), (("alpha_deg", "beta_deg"), "tilt (deg)")), strict=True
    ):
        for offset, estimator, colour in ((-0.2, "learned", "#4c72b0"), (0.2, "true contact", "#dd8452")):
            heights = [np.hypot.reduce([rows[f"{s}, {estimator}"]["rms"][c] for c in components]) for s in scenes]
            axis.bar(position + offset, heights, 0.38, color=colour, label=estimator)
        axis.set_xticks(position, scenes, rotation=30, ha="right")
        axis.set_title(f"RMS error of {title}, true against reference")
        axis.grid(axis="y", alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
