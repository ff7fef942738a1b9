"""Surface following on meshes: seven shapes with both signs of curvature and with creases, covered line by line.

Each is a mesh file, read as a user's would be. Errors are of the true contact; the felt cloud is from estimates alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.felt_cloud import felt_cloud, write_ply
from touchcell.cell.analysis.run_folder import RunFolder, during, rms, tilt_deg, true_contacts
from touchcell.cell.errors import RecordingError
from touchcell.cell.experiments import surface_following
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.sample_meshes import FILES, HEIGHTS_MM
from touchcell.cell.experiments.scenes import distance_to_scene_mm
from touchcell.cell.experiments.shape_truth import shape_rows
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished, Trial
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS

SIZE_MM: Final = (60.0, 40.0)
SPACING_MM: Final = 5.0
SENSOR: Final = "sensor"
ESTIMATORS: Final = {"learned": None, "true contact": {"kind": "true_contact"}}
_QUICK: Final = ("saddle", "ridge")
_SAMPLED: Final = ("saddle", "bowl", "hill", "step")
_RAISED_MM: Final = 25.0


def trials(scale: Scale) -> list[Trial]:
    """Return trials of all shapes with both estimators."""
    shapes = _QUICK if scale.quick else tuple(HEIGHTS_MM)
    return [
        Trial(
            f"{name}_{row.replace(', ', '_').replace(' ', '_')}_{seed}",
            f"{name}, {row}",
            "surface_mesh_sim.yaml",
            {**_changes(name), **changes, "seed": seed},
        )
        for name, row, changes in shape_rows(shapes, ESTIMATORS, _SAMPLED, sensor=SENSOR, arm="arm")
        for seed in range(1, scale.repetitions(1) + 1)
    ]


def _changes(name: str) -> dict[str, Any]:
    mesh = {"kind": "mesh", "file": str(CONFIGS / "meshes" / FILES[name]), "unit": "mm"}
    x_mm = _start_mm(name)
    z_mm = float(HEIGHTS_MM[name](np.array([x_mm]), np.zeros(1))[0]) + _RAISED_MM
    return {"scene.surfaces": {name: mesh}, "arms.arm.start_pose_mm_deg": [x_mm, 0.0, z_mm, 180.0, 0.0, 0.0]}


def _start_mm(name: str) -> float:
    """Return x of the first contact: beside a crease, on which a sensor cannot be checked."""
    return 12.0 if name in ("ridge", "trough") else 0.0


def measure(trial: RunFolder) -> Mapping[str, float]:
    """Return RMS errors while the task ran, how much of the area was covered, and how far the felt cloud is off."""
    try:
        cloud = felt_cloud(trial, SENSOR)
    except RecordingError:
        # It ended before it followed anything: its outcome says why.
        return {}
    write_ply(cloud, trial.path / "felt.ply")
    series, contacts = true_contacts(trial, SENSOR)
    running = contacts[during(trial, series)]
    return {
        **surface_following.measure(trial),
        "tilt_max_deg": float(np.nanmax(tilt_deg(running), initial=0.0)),
        "covered_percent": 100.0 * covered(1e3 * (cloud.points[:, :2] - cloud.points[0, :2])),
        "cloud_rms_mm": rms(distance_to_scene_mm(trial, cloud.points)),
    }


def covered(points_mm: Array) -> float:
    """Return the share of the area, in squares of 1 mm, that has a felt point within 3/5 of the spacing of lines."""
    x, y = (np.arange(-0.5 * size + 0.5, 0.5 * size) for size in SIZE_MM)
    squares = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    near = np.zeros(len(squares), bool)
    for start in range(0, len(points_mm), 256):
        off = squares[:, None] - points_mm[None, start : start + 256]
        near |= (np.einsum("spc,spc->sp", off, off) <= (0.6 * SPACING_MM) ** 2).any(axis=1)
    return float(near.mean())


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Draw each shape with the felt cloud on it, for the first repetition with the learned estimator."""
    from touchcell.cell.experiments.shape_plots import plot_felt

    first = [each for each in finished if each.trial.name.endswith("learned_1")]
    return [plot_felt([each.folder for each in first], [each.trial.row for each in first], folder / "felt.png")]


SPEC = ExperimentSpec(
    name="surface_meshes",
    summary="seven meshes, covered line by line at 3 mm depth and 30 mm/s",
    trials=trials,
    measure=measure,
    columns=(
        Column("depth_rms_mm", "depth RMS mm", digits=3, below=0.2),
        Column("tilt_rms_deg", "tilt RMS deg", digits=2, below=1.5),
        Column("tilt_max_deg", "worst", "worst", 1),
        Column("covered_percent", "covered %", digits=1),
        Column("cloud_rms_mm", "felt cloud RMS mm", digits=3, below=0.3),
        Column("estimated_depth_rms_mm", "estimate: mm", digits=3),
        Column("estimated_tilt_rms_deg", "deg", digits=2),
    ),
    draw=draw,
    notes=(
        "covered: within 3 mm of a felt point, of 60 x 40 mm about the first one, in lines 5 mm apart",
        "trough: the tip does not fit into its hollow crease, as `touchcell check` says",
    ),
)
