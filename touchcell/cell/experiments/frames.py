"""Sensor frames and surfaces in plots, as the paper draws them: red, green and blue arrows about once a second."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from touchcell.cell.analysis.run_folder import Poses

AXIS_COLOURS = ("#d62728", "#2ca02c", "#1f77b4")
BLUE, ORANGE, GREY = "#4c72b0", "#dd8452", "#8c8c8c"


def frames_2d(axis: plt.Axes, poses: Poses, view: tuple[int, int], *, every_s: float = 1.0, length_mm: float) -> None:
    """Draw the frames of ``poses`` in two of the world's axes (0 for x ...), in mm."""
    for T in poses.at(np.arange(poses.t_s[0], poses.t_s[-1], every_s)):
        start = 1e3 * T[:3, 3]
        for i, colour in enumerate(AXIS_COLOURS):
            end = start + length_mm * T[:3, i]
            axis.plot([start[view[0]], end[view[0]]], [start[view[1]], end[view[1]]], color=colour, lw=1.4)


def path_2d(axis: plt.Axes, poses: Poses, view: tuple[int, int], **style: object) -> None:
    """Draw the path of the origin of ``poses``."""
    points = 1e3 * poses.T_world[:, :3, 3]
    axis.plot(points[:, view[0]], points[:, view[1]], **style)


def label_2d(axis: plt.Axes, view: tuple[int, int], title: str = "") -> None:
    """Name the axes, in mm, equal in scale."""
    axis.set_xlabel("xyz"[view[0]] + " (mm)")
    axis.set_ylabel("xyz"[view[1]] + " (mm)")
    axis.set_aspect("equal", adjustable="datalim")
    axis.grid(alpha=0.3)
    if title:
        axis.set_title(title)


def save(figure: plt.Figure, path: Path, *, dpi: int = 90) -> Path:
    """Save and close the figure."""
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
    return path
