"""The paper's figures 16 and 17: paths of the sensor over ramp and dome, with depth and tilt over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from touchcell.cell.analysis.run_folder import Poses, RunFolder, sensor_poses, tilt_deg, true_contacts
from touchcell.cell.experiments.frames import BLUE, GREY, ORANGE, frames_2d, label_2d, path_2d, save
from touchcell.cell.experiments.scenes import surface
from touchcell.geometry.types import Array
from touchcell.simulation.outlines import height_mm

_SIDE, _ABOVE = (0, 2), (0, 1)


def plot_ramp(trial: RunFolder, path: Path) -> Path:
    """Plot the path from the side with the ramp's profile and from above, and the errors over time."""
    figure, axes = plt.subplots(2, 2, figsize=(13, 7.5), layout="constrained")
    poses = _while_running(trial)
    way_mm = 1e3 * poses.T_world[:, 0, 3]
    _profile(axes[0, 0], trial, np.linspace(way_mm.min() - 25, way_mm.max() + 25, 300), np.array([1.0, 0.0]))
    for axis, view, title in ((axes[0, 0], _SIDE, "from the side"), (axes[0, 1], _ABOVE, "from above")):
        path_2d(axis, poses, view, color="black", lw=1.2)
        frames_2d(axis, poses, view, length_mm=12.0)
        label_2d(axis, view, f"sensor frames once a second, {title}")
    _errors(axes[1], [trial], [""])
    return save(figure, path)


def plot_dome(trials: Sequence[RunFolder], path: Path) -> Path:
    """Plot all paths from above, each from the side along its own direction, and the errors over time."""
    figure, axes = plt.subplots(2, 2, figsize=(13, 9), layout="constrained")
    names = []
    for number, trial in enumerate(trials, 1):
        poses = _while_running(trial)
        path_2d(axes[0, 0], poses, _ABOVE, color="black", lw=1.2)
        frames_2d(axes[0, 0], poses, _ABOVE, length_mm=9.0)
        end = 1e3 * poses.T_world[-1, :3, 3]
        direction = end[:2] / np.linalg.norm(end[:2])
        axes[0, 0].annotate(str(number), 1.12 * end[:2], ha="center", va="center", fontsize=11)
        axes[0, 0].update_datalim([1.25 * end[:2]])
        out_mm = 1e3 * poses.T_world[:, :2, 3] @ direction
        axes[0, 1].plot(out_mm, 1e3 * poses.T_world[:, 2, 3], lw=1.0, color="black")
        names.append(str(number))
        if number == 1:
            _profile(axes[0, 1], trial, np.linspace(-20, 105, 300), direction)
    label_2d(axes[0, 0], _ABOVE, "sensor frames once a second, from above")
    label_2d(axes[0, 1], _SIDE, "sensor centres, each path along its own direction")
    axes[0, 1].set_xlabel("distance from the centre (mm)")
    _errors(axes[1], trials, names)
    return save(figure, path)


def _errors(axes: Array, trials: Sequence[RunFolder], names: Sequence[str]) -> None:
    for trial, name in zip(trials, names, strict=True):
        series, contacts = true_contacts(trial, "sensor")
        running = trial.recording.during(series.t_s, "run")
        t_s = series.t_s[running] - series.t_s[running][0]
        colour = BLUE if len(trials) == 1 else None
        axes[0].plot(t_s, contacts[running, 2], lw=1.0, color=colour, label=name)
        axes[1].plot(t_s, tilt_deg(contacts[running]), lw=1.0, color=colour, label=name)
    axes[0].axhline(3.0, color="black", ls="--", lw=0.9)
    axes[0].set_title("true depth (mm); dashed: reference")
    axes[1].set_title("true tilt against the surface's normal (deg)")
    axes[1].set_ylim(bottom=0.0)
    for axis in axes:
        axis.set_xlabel("time since the contact settled (s)")
        axis.grid(alpha=0.3)
    if len(trials) > 1:
        axes[1].legend(ncols=2, fontsize=9, title="path")


def _while_running(trial: RunFolder) -> Poses:
    poses = sensor_poses(trial, "sensor")
    inside = trial.recording.during(poses.t_s - 1e-9 * trial.recording.start_ns, "run")
    return Poses(poses.t_s[inside], poses.T_world[inside])


def _profile(axis: plt.Axes, trial: RunFolder, along_mm: Array, direction: Array) -> None:
    """Plot the surface's height over a line through the origin, from its closed form."""
    x, y = 1e-3 * along_mm * direction[0], 1e-3 * along_mm * direction[1]
    heights = height_mm(surface(trial), x, y, 0.0)
    axis.fill_between(along_mm, heights, heights.min() - 8, color=GREY, alpha=0.35, lw=0)
    axis.plot(along_mm, heights, color=ORANGE, lw=1.2)
