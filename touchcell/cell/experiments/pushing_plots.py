"""The paper's figures 18 to 20: pushes in top view with sensor frames and outlines, and the errors of all trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from touchcell.cell.analysis.push_errors import pushed_until_s, target_m
from touchcell.cell.analysis.run_folder import Poses, RunFolder, object_poses, sensor_poses
from touchcell.cell.experiments.frames import BLUE, ORANGE, frames_2d, label_2d, path_2d, save
from touchcell.cell.experiments.push_measures import AIM_MM, OBJECT, lean_deg
from touchcell.cell.experiments.scenes import scene
from touchcell.cell.experiments.trials import Finished
from touchcell.simulation.outlines import ABOVE, SIDE, View, solid_outlines_mm

_RED = "#d62728"


def plot_pushes(finished: Sequence[Finished], path: Path, *, view: View = ABOVE) -> Path:
    """Plot each trial in a panel: paths and frames of the sensors, the object at start and end, the target."""
    columns = min(4, len(finished))
    rows = -(-len(finished) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4.6 * columns, 2.9 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat[len(finished) :]:
        axis.set_axis_off()
    for axis, each in zip(axes.flat, finished, strict=False):
        error = each.measures.get("object_error_mm")
        title = each.trial.row + ("" if error is None or not each.done else f": {error:.2f} mm")
        _draw_push(axis, each.folder, view)
        label_2d(axis, view, title if each.done else f"{title} ({each.outcome})")
    return save(figure, path, dpi=80)


def plot_errors(finished: Sequence[Finished], path: Path) -> Path:
    """Plot every trial's error, by row, with the goal."""
    rows = list(dict.fromkeys(each.trial.row for each in finished))
    figure, axis = plt.subplots(figsize=(0.55 * len(rows) + 3.0, 4.6), layout="constrained")
    for i, row in enumerate(rows):
        errors = [
            each.measures["object_error_mm"]
            for each in finished
            if each.trial.row == row and each.done and "object_error_mm" in each.measures
        ]
        colour = ORANGE if "matched" in row else BLUE
        axis.plot(np.full(len(errors), i), errors, "o", ms=5, color=colour, alpha=0.75)
        if errors:
            axis.plot([i - 0.25, i + 0.25], [np.mean(errors)] * 2, color="black", lw=1.4)
    axis.axhline(AIM_MM, color=_RED, ls="--", lw=1.0, label=f"aim: {AIM_MM:g} mm")
    axis.set_xticks(range(len(rows)), rows, rotation=40, ha="right", fontsize=8)
    axis.set_ylabel("object to target (mm)")
    axis.set_ylim(bottom=0.0)
    axis.grid(axis="y", alpha=0.3)
    axis.legend()
    return save(figure, path, dpi=80)


def _draw_push(axis: plt.Axes, run: RunFolder, view: View) -> None:
    end_s = pushed_until_s(run)
    poses = object_poses(run)[OBJECT]
    solid = scene(run).objects[OBJECT].shape.build()
    last = poses.T_world[-1] if end_s is None else poses.at(np.array([end_s]))[0]
    for T_world_object, style in ((poses.T_world[0], ":"), (last, "-")):
        for outline in solid_outlines_mm(solid, T_world_object, view):
            axis.plot(*outline.T, color="#8c6d3f", lw=1.1, ls=style)
    for role in run.plan.sensor_roles:
        sensor = sensor_poses(run, role)
        if end_s is not None:
            before = sensor.t_s <= end_s
            sensor = Poses(sensor.t_s[before], sensor.T_world[before])
        path_2d(axis, sensor, view, color="black", lw=0.9)
        frames_2d(axis, sensor, view, length_mm=11.0)
    if view == SIDE:
        axis.axhline(scene(run).table.height_mm, color="#8c8c8c", lw=1.0)
    else:
        x, y = 1e3 * target_m(run)
        axis.plot(x, y, "o", ms=9, mfc="none", mec=_RED, mew=1.2)
        axis.plot(x, y, ".", ms=4, color=_RED)


def plot_leans(finished: Mapping[str, Sequence[Finished]], path: Path) -> Path:
    """Plot each object's lean over time, one panel for each of ``finished``."""
    figure, axes = plt.subplots(1, len(finished), figsize=(6 * len(finished), 4.4), sharey=True, layout="constrained")
    for axis, (title, trials) in zip(axes, finished.items(), strict=True):
        for each in trials:
            name = each.trial.row.partition(",")[0]
            axis.plot(object_poses(each.folder)[OBJECT].t_s, lean_deg(each.folder), lw=1.1, label=name)
        axis.set_title(title)
        axis.set_xlabel("time (s)")
        axis.set_yscale("symlog", linthresh=1.0)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("lean from the vertical (deg)")
    axes[-1].legend(fontsize=8, ncols=2)
    return save(figure, path, dpi=80)


def plot_map(
    errors_mm: Sequence[Sequence[float]],
    columns: Sequence[float],
    rows: Sequence[float],
    labels: tuple[str, str],
    path: Path,
) -> Path:
    """Draw the object's error over two quantities; NaN, for a push that did not arrive, as a cross.

    Args:
        errors_mm: by row and column.
        columns, rows: values of the quantities.
        labels: of the columns and of the rows, with units.
        path: of the picture.
    """
    errors = np.array(errors_mm, dtype=np.float64)
    figure, axes = plt.subplots(figsize=(1.6 + 0.7 * len(columns), 1.4 + 0.5 * len(rows)), layout="constrained")
    image = axes.imshow(errors, origin="lower", cmap="viridis", vmin=0.0, vmax=2.0, aspect="auto")
    for i, j in np.ndindex(errors.shape):
        text, colour = ("x", "red") if np.isnan(errors[i, j]) else (f"{errors[i, j]:.1f}", "white")
        axes.text(j, i, text, ha="center", va="center", color=colour)
    axes.set_xticks(range(len(columns)), [f"{value:g}" for value in columns])
    axes.set_yticks(range(len(rows)), [f"{value:g}" for value in rows] if len(rows) > 1 else [""])
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    figure.colorbar(image, label="object from target, mm")
    return save(figure, path, dpi=100)
