"""Shapes in three dimensions with what was felt of them: clouds over surfaces, paths along edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from touchcell.cell.analysis.felt_cloud import felt_cloud
from touchcell.cell.analysis.run_folder import RunFolder, during, scene_time, sensor_poses
from touchcell.cell.experiments.frames import BLUE, GREY, ORANGE, save
from touchcell.cell.experiments.scenes import distance_to_scene_mm, surface
from touchcell.geometry.types import Array
from touchcell.simulation.shape_drawing import drawn_surface

_COLUMNS = 4


def plot_felt(trials: Sequence[RunFolder], names: Sequence[str], path: Path) -> Path:
    """Draw each surface with its felt cloud, coloured by how far the points are off it."""
    figure, axes = _grid(len(trials))
    shown = None
    for axis, trial, name in zip(axes, trials, names, strict=False):
        drawn = _draw_surface(axis, trial)
        cloud = felt_cloud(trial)
        points = 1e3 * cloud.points[::3]
        off = distance_to_scene_mm(trial, cloud.points[::3])
        shown = axis.scatter(*points.T, c=off, s=2.0, cmap="coolwarm", vmin=-0.3, vmax=0.3, depthshade=False, zorder=3)
        axis.set_title(name, fontsize=9)
        _frame(axis, np.concatenate([points, drawn]))
    if shown is not None:
        figure.colorbar(shown, ax=axes.tolist(), shrink=0.5, label="felt point off the surface (mm)")
    return save(figure, path)


def plot_edges(trials: Sequence[RunFolder], names: Sequence[str], path: Path) -> Path:
    """Draw each part with the path of the tip's apex along its edge."""
    figure, axes = _grid(len(trials))
    for axis, trial, name in zip(axes, trials, names, strict=False):
        drawn = _draw_surface(axis, trial)
        series = trial.recording.series("/sensors/sensor/true_edge")
        assert series is not None
        T = sensor_poses(trial, "sensor").at(scene_time(trial, series)[during(trial, series)])
        apex = 1e3 * (T[:, :3, 3] + 0.017 * T[:, :3, 2])
        axis.plot(*apex.T, color=BLUE, lw=1.6, zorder=3)
        axis.scatter(*apex[:1].T, color=ORANGE, s=18, depthshade=False, zorder=4)
        axis.set_title(name, fontsize=9)
        _frame(axis, np.concatenate([apex, drawn]))
    return save(figure, path)


def _grid(count: int) -> tuple[Any, Any]:
    rows = max(math.ceil(count / _COLUMNS), 1)
    figure = plt.figure(figsize=(4.0 * _COLUMNS, 3.6 * rows), layout="constrained")
    # What was felt lies on the surface, and is drawn over it.
    axes = [figure.add_subplot(rows, _COLUMNS, i + 1, projection="3d", computed_zorder=False) for i in range(count)]
    return figure, np.array(axes)


def _draw_surface(axis: Any, trial: RunFolder) -> Array:
    """Draw the mesh and return its corners (n, 3) mm."""
    mesh = drawn_surface(surface(trial), 0.0)
    corners = 1e3 * mesh.vertices
    axis.plot_trisurf(*corners.T, triangles=mesh.faces, color=GREY, alpha=0.35, lw=0.0, zorder=1)
    return corners


def _frame(axis: Any, points: Array) -> None:
    """Fit the axes around ``points`` (n, 3) mm: nothing is cut off at them in three dimensions."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = 0.52 * float(np.ptp(points, axis=0).max())
    for set_limits, value in zip((axis.set_xlim, axis.set_ylim, axis.set_zlim), middle, strict=True):
        set_limits(value - reach, value + reach)
    axis.set_box_aspect((1, 1, 1))
    axis.view_init(elev=40, azim=-60)
    axis.tick_params(labelsize=6)
