"""Edge following: outlines of flat parts and rims of curved sheets, once around each, at 30 mm/s.

Errors are of the true edge; beside them stand those of the estimate. Lateral error and angle are given away from
corners, where the edge itself jumps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder, during, rms
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.sample_meshes import FILES, HEIGHTS_MM
from touchcell.cell.experiments.shape_truth import shape_rows
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished, Trial
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS

SENSOR: Final = "sensor"
ESTIMATORS: Final[dict[str, dict[str, Any] | None]] = {
    "learned": None,
    "true edge with noise": {"kind": "true_edge", "noise_mm": 0.1, "noise_deg": 0.5},
}
MODES: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "circle, 2D": ("circle", {"task.dimensions": 2}),
    "square, 2D backwards": ("square", {"task.dimensions": 2, "task.direction": "backward"}),
    "saddle, 3D": ("saddle", {"task.dimensions": 3}),
    "bowl, 3D backwards": ("bowl", {"task.dimensions": 3, "task.direction": "backward"}),
    "clover, 5D backwards": ("clover", {"task.direction": "backward"}),
    "foil, 5D open": ("foil", {"task.close_loop": False, "task.distance_mm": 80.0}),
    "ell, 5D open backwards": (
        "ell",
        {"task.close_loop": False, "task.distance_mm": 80.0, "task.direction": "backward"},
    ),
}
"""Other ways of following than once around in five dimensions: the row's name, the shape and changes of the cell."""
_SAMPLED: Final = ("circle", "square", "clover", "bowl")
_QUICK: Final = ("circle", "square")
_HEIGHT_MM: Final = 20.0
_RIM_MM: Final = 45.0
_TIP_MM: Final = 20.0
_ABOVE_MM: Final = 5.0
_INSIDE_MM: Final = 2.0
_INSIDE_RIM_MM: Final = 0.5
"""On a face that leans its edge is not told from its middle farther inside."""
_CORNER_DEG: Final = 20.0
_CORNER_S: Final = 0.35


def _polar(radius: Any, count: int = 180) -> Array:
    angle = np.arange(count) * 2.0 * math.pi / count
    r = radius(angle)
    outline: Array = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    return outline


def _foil() -> Array:
    """Return a symmetric NACA 0025 profile of 120 mm, counter-clockwise from its trailing edge."""
    x = 0.5 * (1.0 + np.cos(np.linspace(0.0, math.pi, 60)))
    half = 1.25 * (0.2969 * np.sqrt(x) - 0.1260 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    outline = np.concatenate([np.stack([x, half], 1), np.stack([x, -half], 1)[-2:0:-1]])
    foil: Array = 120.0 * (outline - np.array([0.4, 0.0]))
    return foil


def _leaf() -> Array:
    y = np.linspace(-50.0, 50.0, 61)
    x = 28.0 * (1.0 - (y / 50.0) ** 2)
    return np.concatenate([np.stack([x, y], 1), np.stack([-x, y], 1)[-2:0:-1]])


OUTLINES_MM: Final[dict[str, Array]] = {
    "square": np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]]),
    "clover": _polar(lambda angle: 45.0 + 6.0 * np.cos(4.0 * angle)),
    "foil": _foil(),
    "hexagon": 45.0 * np.array([[math.cos(math.pi * i / 3), math.sin(math.pi * i / 3)] for i in range(6)]),
    "star": np.array(
        [
            [r * math.cos(math.pi * i / 5), r * math.sin(math.pi * i / 5)]
            for i in range(10)
            for r in [(50.0, 32.0)[i % 2]]
        ]
    ),
    "ell": np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 0.0], [0.0, 0.0], [0.0, 40.0], [-40.0, 40.0]]),
    "leaf": _leaf(),
}
"""Corners of flat outlines, mm, counter-clockwise."""

RIMS: Final = ("saddle", "wave")
"""Curved sheets of ``sample_meshes``, cut by a cylinder: outlines in three dimensions."""

SHAPES: Final = ("circle", "square", "clover", "foil", "saddle", "bowl", "hexagon", "star", "ell", "leaf", "wave")


def surface_of(name: str) -> dict[str, Any]:
    """Return the surface of a shape, as a section of a scene."""
    if name == "circle":
        return {"kind": "cylinder", "radius_mm": 50.0, "height_mm": _HEIGHT_MM}
    if name == "bowl":
        hollow = {"kind": "sphere", "radius_mm": 50.0, "pose_mm_deg": [0.0, 0.0, 50.0, 0.0, 0.0, 0.0]}
        block = {"kind": "cylinder", "radius_mm": 75.0, "height_mm": _HEIGHT_MM}
        return {"kind": "difference", "parts": {"block": block, "hollow": hollow}}
    if name in RIMS:
        sheet = {"kind": "mesh", "file": str(CONFIGS / "meshes" / FILES[name]), "unit": "mm"}
        cut = {
            "kind": "cylinder",
            "radius_mm": _RIM_MM,
            "height_mm": 80.0,
            "pose_mm_deg": [0.0, 0.0, -_HEIGHT_MM, 0.0, 0.0, 0.0],
        }
        return {"kind": "intersection", "parts": {"sheet": sheet, "cut": cut}}
    return {"kind": "extrusion", "outline_mm": OUTLINES_MM[name].round(4).tolist(), "height_mm": _HEIGHT_MM}


def start_pose_mm_deg(name: str, *, upright: bool = False) -> list[float]:
    """Return a pose 5 mm above a face and 2 mm or less inside its edge, with x across the edge, away from the face.

    The tip looks towards the face, or, if ``upright``, down.
    """
    raised = _HEIGHT_MM + _TIP_MM + _ABOVE_MM
    if name == "circle":
        return [50.0 - _INSIDE_MM, 0.0, raised, 180.0, 0.0, 0.0]
    if name == "bowl":
        # The face beside its inner rim lies outside: x leads inwards.
        return [40.0 + _INSIDE_MM, 0.0, raised, 180.0, 0.0, 180.0]
    if name in RIMS:
        # Towards the face, as `touchcell check` asks for.
        x = _RIM_MM - _INSIDE_RIM_MM + np.array([-0.1, 0.0, 0.1])
        low, height, high = HEIGHTS_MM[name](x, np.zeros(3)).tolist()
        lean = math.atan2(high - low, 0.2)
        away = np.array([-math.sin(lean), math.cos(lean)])
        edge = np.array([_RIM_MM - _INSIDE_RIM_MM, height])
        if upright:
            x_mm, z_mm = (edge + _TIP_MM * away + np.array([0.0, _ABOVE_MM])).tolist()
            return [x_mm, 0.0, z_mm, 180.0, 0.0, 0.0]
        over = edge + (_TIP_MM + _ABOVE_MM) * away
        return [float(over[0]), 0.0, float(over[1]), 180.0, -float(np.degrees(lean)), 0.0]
    outline = OUTLINES_MM[name]
    # In the middle of a piece near the first third, away from corners of shapes that begin with one.
    i = len(outline) // 3
    one, other = outline[i], outline[(i + 1) % len(outline)]
    way = (other - one) / np.linalg.norm(other - one)
    across = np.array([way[1], -way[0]])
    x, y = 0.5 * (one + other) - _INSIDE_MM * across
    return [float(x), float(y), raised, 180.0, 0.0, float(np.degrees(math.atan2(across[1], across[0])))]


def trials(scale: Scale) -> list[Trial]:
    """Return trials of all shapes with each estimator, half of them backwards, and of the other modes."""
    shapes = _QUICK if scale.quick else SHAPES
    rows = list(shape_rows(shapes, ESTIMATORS, _SAMPLED, sensor=SENSOR, arm="arm"))
    modes = () if scale.quick else MODES.items()
    return [
        Trial(
            f"{name}_{row.replace(', ', '_').replace(' ', '_')}_{seed}",
            f"{name}, {row}",
            "edge_follow_sim.yaml",
            {
                "scene.surfaces": {name: surface_of(name)},
                # A tip that keeps its tilt meets the least of it where it begins upright.
                "arms.arm.start_pose_mm_deg": start_pose_mm_deg(name, upright="task.dimensions" in changes),
                "task.distance_mm": 800.0,
                "task.direction": ("forward", "backward")[SHAPES.index(name) % 2],
                "interlocks.tilt.limit_deg": 60,
                "interlocks.workspace.min_mm": [-120, -120, -40],
                **changes,
                "seed": seed,
            },
        )
        for name, row, changes in rows + [(name, mode.partition(", ")[2], changes) for mode, (name, changes) in modes]
        for seed in range(1, scale.repetitions(1) + 1)
    ]


def measure(trial: RunFolder) -> Mapping[str, float]:
    """Return RMS errors of the true edge while the task ran, over everything and away from corners."""
    series = trial.recording.series(f"/sensors/{SENSOR}/true_edge")
    assert series is not None
    running = during(trial, series)
    edge, t_s = series.poses()[running], series.t_s[running]
    away = away_from_corners(t_s, edge[:, 5])
    estimated = trial.recording.series(f"/sensors/{SENSOR}/contact")
    assert estimated is not None
    believed = estimated.poses()[: len(series.t_s)][running[: len(estimated.t_s)]]
    off = (believed - edge[: len(believed)])[away[: len(believed)]]
    return {
        "lateral_rms_mm": rms(edge[away, 0]),
        "angle_rms_deg": rms(edge[away, 5]),
        "depth_rms_mm": rms(edge[:, 2] - 3.0),
        "tilt_rms_deg": rms(np.hypot(edge[:, 3], edge[:, 4])),
        "lateral_max_mm": float(np.nanmax(np.abs(edge[:, 0]), initial=0.0)),
        "estimated_lateral_rms_mm": rms(off[:, 0]),
        "estimated_angle_rms_deg": rms(off[:, 5]),
        "corner_percent": 100.0 * float(1.0 - away.mean()) if len(away) else float("nan"),
        "duration_s": float(t_s[-1] - t_s[0]) if len(t_s) else float("nan"),
    }


def away_from_corners(t_s: Array, turn_deg: Array) -> Any:
    """Return a mask (n,) of samples further than a third of a second from a jump of the edge's direction."""
    jumps = t_s[np.abs(turn_deg) > _CORNER_DEG]
    mask = np.ones(len(t_s), bool)
    for t in jumps:
        mask &= np.abs(t_s - t) > _CORNER_S
    return mask


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Draw each shape with the path along its edge, and the errors over the way."""
    from touchcell.cell.experiments.shape_plots import plot_edges

    first = [each for each in finished if each.trial.name.endswith("learned_1")]
    return [plot_edges([each.folder for each in first], [each.trial.row for each in first], folder / "edges.png")]


SPEC = ExperimentSpec(
    name="edge_following",
    summary="eleven outlines and rims, once around each at 3 mm depth and 30 mm/s",
    trials=trials,
    measure=measure,
    columns=(
        Column("lateral_rms_mm", "lateral RMS mm", digits=3, below=0.3),
        Column("lateral_max_mm", "largest", "worst", 2),
        Column("angle_rms_deg", "angle RMS deg", digits=2, below=2.0),
        Column("depth_rms_mm", "depth RMS mm", digits=3),
        Column("tilt_rms_deg", "tilt RMS deg", digits=2),
        Column("corner_percent", "at corners %", digits=0),
        Column("estimated_lateral_rms_mm", "estimate: mm", digits=3),
        Column("estimated_angle_rms_deg", "deg", digits=2),
        Column("duration_s", "s", digits=1),
    ),
    draw=draw,
    notes=(
        "rows without a mode are 5D and closed; square, foil, bowl, star and leaf backwards",
        "done: the loop is closed. Lateral and angle RMS away from corners; largest lateral error anywhere",
    ),
)
