"""Object tracking (paper 5.4): a plate moves one component at a time, then all six at once.

The sensor holds 6 mm depth.

Errors are geometric, of the sensor against its pose if it stuck to the plate where it first touched it, so undetected
slip counts as well. The motion in all six components also runs at other frame rates and latencies, with a plate that
moves already when it is touched, which drags the tip while the sensor is checked, and with truth sampled apart from
what the controllers are told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from touchcell.cell.analysis.run_folder import RunFolder, rms
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.shape_truth import REAL_TIP, SAMPLED, sampled_truth
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.tracking_error import tracking
from touchcell.cell.experiments.trials import Finished, Trial
from touchcell.cell.recording.messages import COMPONENTS

SENSOR = "sensor"
ARM = "arm"
CELL = "object_track_sim.yaml"
ALL_SIX = "all six"
RATES_HZ = (15, 30, 60)
LATENCIES_MS = (0, 10, 30)
_START_S, _MOVE_S = 4.0, 10.0
# Motion of each single component, and the plate's start such that it stays inside the arm's workspace.
_MOVES: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "x, 200 mm": ((200, 0, 0, 0, 0, 0), (-100, 0, 0)),
    "y, 200 mm": ((0, 200, 0, 0, 0, 0), (0, -100, 0)),
    "z, 200 mm": ((0, 0, 200, 0, 0, 0), (0, 0, -100)),
    "alpha, 30 deg": ((0, 0, 0, 30, 0, 0), (0, 0, 0)),
    "beta, 30 deg": ((0, 0, 0, 0, 30, 0), (0, 0, 0)),
    "gamma, 45 deg": ((0, 0, 0, 0, 0, 45), (0, 0, 0)),
}


def trials(scale: Scale) -> list[Trial]:
    """Return trials of each component and all six at the cell's own camera; all six over rates and latencies."""
    found = []
    for row, (way, start) in _MOVES.items():
        x, y, z = start
        changes: dict[str, Any] = {
            "scene.surfaces.plate.pose_mm_deg": [x, y, z, 0, 0, 0],
            "scene.surfaces.plate.motion": {
                "kind": "glide",
                "displacement_mm_deg": list(way),
                "start_s": _START_S,
                "duration_s": _MOVE_S,
            },
            "arms.arm.start_pose_mm_deg": [x, y, z + 25, 180, 0, 0],
            "task.duration_s": _MOVE_S + 3.0,
            "interlocks.workspace.min_mm": [-150, -150, -150],
            "interlocks.workspace.max_mm": [150, 150, 160],
            "interlocks.tilt.limit_deg": 45,
        }
        found += _repeated(row, row.partition(",")[0], changes, scale)
    combinations = [(rate, latency) for rate in RATES_HZ for latency in LATENCIES_MS]
    if scale.quick:
        combinations = [(30, 10), (15, 30)]
    for rate_hz, latency_ms in combinations:
        changes = {f"sensors.{SENSOR}.rate_hz": rate_hz, f"sensors.{SENSOR}.latency_ms": latency_ms}
        if scale.quick:
            changes["task.duration_s"] = 20
        row = f"{ALL_SIX}, {rate_hz} Hz, {latency_ms} ms"
        found += _repeated(row, f"all_{rate_hz}hz_{latency_ms}ms", changes, scale)
    at_once = {"scene.surfaces.plate.motion.start_s": 0.0}
    for name, check in (("moves_at_once", {}), ("moves_at_once_unchecked", {"task.check_s": 0.0})):
        row = f"{ALL_SIX}, moving at first touch{', sensor not checked' if check else ''}"
        found += _repeated(row, name, at_once | check, scale)
    changes = {"truth": sampled_truth(SENSOR, ARM, REAL_TIP)} | ({"task.duration_s": 20} if scale.quick else {})
    return found + _repeated(f"{ALL_SIX}, {SAMPLED}", "all_sampled", changes, scale)


def _repeated(row: str, name: str, changes: Mapping[str, Any], scale: Scale) -> list[Trial]:
    seeds = range(1, scale.repetitions(10) + 1)
    return [Trial(f"{name}_{seed}", row, CELL, {**changes, "seed": seed}) for seed in seeds]


def measure(trial: RunFolder) -> Mapping[str, float]:
    """Return the RMS error of each component of the sensor's pose against a sensor that sticks on first touch."""
    _, _, error = tracking(trial)
    return {f"{name}_rms": rms(error[:, i]) for i, name in enumerate(COMPONENTS)}


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot the paper's figures 14 and 15, and the error over frame rate and latency."""
    from touchcell.cell.experiments.tracking_plots import plot_all_six, plot_components, plot_sweep

    first = {each.trial.row: each for each in finished if each.trial.name.endswith("_1")}
    return [
        plot_components({row: first[row].folder for row in _MOVES}, folder / "components.png"),
        plot_all_six(first[f"{ALL_SIX}, 30 Hz, 10 ms"].folder, folder / "all_six.png"),
        plot_sweep(
            [each for each in finished if each.trial.row.endswith(" ms")],
            folder / "sweep.png",
        ),
    ]


SPEC = ExperimentSpec(
    name="object_tracking",
    summary="a plate moves one component at a time and all six at once; the sensor holds 6 mm depth",
    trials=trials,
    measure=measure,
    columns=tuple(
        Column(f"{name}_rms", title)
        for name, title in zip(COMPONENTS, ("x mm", "y mm", "z mm", "alpha deg", "beta deg", "gamma deg"), strict=True)
    ),
    draw=draw,
    paper=dict.fromkeys(_MOVES, "tracks (no figure)") | {f"{ALL_SIX}, 30 Hz, 10 ms": "tracks (no figure)"},
    notes=("errors RMS, of the sensor against one that sticks where it first touched the plate",),
)
