"""The paper's figures 14 and 15: poses of leader and follower; and error over frame rate and latency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from touchcell.cell.analysis.run_folder import Poses, RunFolder
from touchcell.cell.experiments.frames import BLUE, ORANGE, frames_2d, label_2d, path_2d, save
from touchcell.cell.experiments.tracking_error import tracking
from touchcell.cell.experiments.trials import Finished
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.geometry import se3

_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")


def plot_components(trials: Mapping[str, RunFolder], path: Path) -> Path:
    """Plot the moved component of plate and sensor over time, each trial in a panel, with the error below."""
    figure, axes = plt.subplots(
        2, 6, figsize=(18, 6), sharex=True, height_ratios=(3, 2), layout="constrained", squeeze=False
    )
    for i, (row, trial) in enumerate(trials.items()):
        poses, T_world_plate, error = tracking(trial)
        moved = np.asarray(se3.to_euler_mm_deg(se3.inverse(T_world_plate[0]) @ T_world_plate))
        # Signs differ, as the sensor's axis is opposite to the plate's z axis.
        sign = np.array([1, -1, -1, 1, -1, -1])[i]
        axes[0, i].plot(poses.t_s, moved[:, i], color="black", lw=1.4, label="plate")
        axes[0, i].plot(poses.t_s, moved[:, i] + sign * error[:, i], color=ORANGE, lw=1.2, ls="--", label="sensor")
        axes[0, i].set_title(f"{row} ({_UNITS[i]})")
        axes[1, i].plot(poses.t_s, error[:, i], color=BLUE, lw=1.0)
        axes[1, i].set_title(f"error ({_UNITS[i]})")
        axes[1, i].set_xlabel("time (s)")
    axes[0, 0].legend()
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    return save(figure, path)


def plot_all_six(trial: RunFolder, path: Path) -> Path:
    """Plot the paths of plate and sensor with their frames, in top and side view, and all errors over time."""
    figure, axes = plt.subplots(1, 3, figsize=(18, 6), layout="constrained")
    poses, T_world_plate, error = tracking(trial)
    in_contact = np.isfinite(error[:, 0])
    sensor = Poses(poses.t_s[in_contact], poses.T_world[in_contact])
    plate = Poses(poses.t_s[in_contact], T_world_plate[in_contact])
    for axis, view, title in ((axes[0], (0, 1), "from above"), (axes[1], (0, 2), "from the side")):
        path_2d(axis, plate, view, color="black", lw=1.2, label="plate")
        path_2d(axis, sensor, view, color=ORANGE, lw=1.2, ls="--", label="sensor")
        frames_2d(axis, plate, view, every_s=2.0, length_mm=14.0)
        frames_2d(axis, sensor, view, every_s=2.0, length_mm=14.0)
        label_2d(axis, view, f"frames every 2 s, {title}")
    axes[0].legend()
    for i, (name, unit) in enumerate(zip(COMPONENTS, _UNITS, strict=True)):
        axes[2].plot(poses.t_s, error[:, i], lw=1.0, label=f"{name.partition('_')[0]} ({unit})")
    axes[2].set_title("error")
    axes[2].set_xlabel("time (s)")
    axes[2].legend(ncols=2)
    axes[2].grid(alpha=0.3)
    return save(figure, path)


def plot_sweep(finished: Sequence[Finished], path: Path) -> Path:
    """Plot the RMS of each component over latency, one line for each frame rate."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 6.5), sharex=True, layout="constrained")
    points: dict[tuple[float, float], list[Mapping[str, float]]] = {}
    for each in finished:
        camera = next(iter(each.folder.plan.cell.sensors.values())).model_extra or {}
        points.setdefault((camera["rate_hz"], camera["latency_ms"]), []).append(each.measures)
    for axis, name, unit in zip(axes.flat, COMPONENTS, _UNITS, strict=True):
        for rate_hz in sorted({rate for rate, _ in points}):
            latencies = sorted(latency for rate, latency in points if rate == rate_hz)
            values = [
                np.mean([m[f"{name}_rms"] for m in points[rate_hz, ms] if f"{name}_rms" in m]) for ms in latencies
            ]
            axis.plot(latencies, values, "o-", clip_on=False, lw=1.3, label=f"{rate_hz:g} Hz")
        axis.set_title(f"{name.partition('_')[0]} RMS ({unit})")
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("camera's latency (ms)")
    axes[0, 0].legend(title="frame rate")
    return save(figure, path)
