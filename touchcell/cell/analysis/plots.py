"""Plots of a run. Imported only when needed, because matplotlib is heavy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from touchcell.cell.analysis.run_data import Run, tip_points
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.geometry.types import Array

_TITLES = dict(
    zip(
        COMPONENTS,
        ("shear x (mm)", "shear y (mm)", "depth z (mm)", "tilt α (deg)", "tilt β (deg)", "twist γ (deg)"),
        strict=True,
    )
)
# Order of the panels: the servoed components first.
_PANELS = ("z_mm", "alpha_deg", "beta_deg", "x_mm", "y_mm", "gamma_deg")
# Radius of a TacTip: ticks of this length from the tip's centre trace the surface that it is pressed on.
_TIP_RADIUS_MM = 20.0
_LEAST_EXTENT_MM = 1.0
_STATE_COLOURS = ("#4c72b0", "#dd8452", "#55a868", "#c44e52", "#8172b3", "#937860", "#da8bc3", "#8c8c8c")


def plot_contact(run: Run, sensor: str, path: Path, *, last_s: float | None = None) -> Path:
    """Plot contact pose and shear over time: the estimate with two standard deviations, the truth, and the reference.

    ``last_s`` shows only the end of the run, for replayed images, each of which is another contact.
    """
    contact = run.series(f"/sensors/{sensor}/contact")
    truth = run.series(f"/sensors/{sensor}/truth")
    task = run.series("/task")
    assert contact is not None
    figure = Figure(figsize=(15, 7), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    for axis, name in zip(axes.flat, _PANELS, strict=True):
        value, sigma = contact.column(name), contact.column(f"sigma_{name}")
        axis.fill_between(contact.t_s, value - 2 * sigma, value + 2 * sigma, color="#4c72b0", alpha=0.2, lw=0)
        axis.plot(contact.t_s, value, color="#4c72b0", lw=1.2, label="estimate ± 2σ")
        if truth is not None:
            axis.plot(truth.t_s, truth.column(name), color="#dd8452", lw=1.0, label="true")
        if task is not None and np.isfinite(reference := task.column(f"reference_{name}")).any():
            axis.plot(task.t_s, reference, color="black", lw=0.8, ls="--", label="reference")
        _limit(axis, value, truth.column(name) if truth is not None else value)
        axis.set_title(_TITLES[name])
        axis.grid(alpha=0.3)
        _shade_states(axis, run)
    axes.flat[0].legend(loc="best", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("time (s)")
        if last_s is not None and len(contact.t_s):
            axis.set_xlim(contact.t_s[-1] - last_s, contact.t_s[-1])
    figure.suptitle(f"{sensor}: contact pose and shear of the sensor in the surface frame")
    figure.savefig(path, dpi=100)
    return path


def plot_agreement(run: Run, sensor: str, path: Path) -> Path:
    """Plot estimates over the truth, of single frames and of the filter, with the mean absolute error of each."""
    truth = run.series(f"/sensors/{sensor}/truth")
    assert truth is not None
    figure = Figure(figsize=(14, 9), layout="constrained")
    axes = figure.subplots(2, 3)
    for topic, label, colour, size in (
        ("measurement", "one frame", "#c44e52", 5),
        ("contact", "filtered", "#4c72b0", 5),
    ):
        series = run.series(f"/sensors/{sensor}/{topic}")
        if series is None:
            continue
        index = np.clip(np.searchsorted(truth.t_s, series.t_s + 1e-6, side="right") - 1, 0, len(truth.t_s) - 1)
        for axis, name in zip(axes.flat, _PANELS, strict=True):
            true, value = truth.column(name)[index], series.column(name)
            off = np.abs(value - true)
            error = np.nanmean(off) if np.isfinite(off).any() else np.nan
            axis.plot(true, value, ".", ms=size, alpha=0.35, color=colour, mew=0, label=f"{label}: {error:.3f}")
    for axis, name in zip(axes.flat, _PANELS, strict=True):
        low, high = axis.get_xlim()
        axis.plot([low, high], [low, high], color="black", lw=0.8)
        axis.set_title(_TITLES[name])
        axis.set_xlabel("true")
        axis.grid(alpha=0.3)
        axis.legend(title="mean absolute error", fontsize=9, markerscale=2)
    axes[0, 0].set_ylabel("estimate")
    axes[1, 0].set_ylabel("estimate")
    figure.savefig(path, dpi=100)
    return path


def plot_trajectory(run: Run, path: Path, mounts: Mapping[str, tuple[Array, Array]]) -> Path:
    """Plot the arms' paths in side and top view with the sensor's axis, coloured by the task's state.

    Args:
        run: its recording.
        path: PNG to write.
        mounts: by arm, the poses (4, 4) of its base in the world and of its sensor in its tool; None means that both
            are the identity.
    """
    figure = Figure(figsize=(15, 6), layout="constrained")
    axes = figure.subplots(1, 2)
    states = _states(run)
    colours = {state: _STATE_COLOURS[i % len(_STATE_COLOURS)] for i, state in enumerate(states)}
    for arm in run.roles("arms", "tcp"):
        series = run.series(f"/arms/{arm}/tcp")
        assert series is not None
        T_world_base, T_tcp_sensor = mounts.get(arm, (np.eye(4), np.eye(4)))
        T = T_world_base @ tip_points(series) @ T_tcp_sensor
        points = 1e3 * T[:, :3, 3]
        # The side view is along the horizontal axis in which the path is narrowest.
        along = int(np.argmax(np.ptp(points[:, :2], axis=0)))
        for axis, (i, j) in zip(axes, ((along, 2), (0, 1)), strict=True):
            _draw_path(axis, run, series.t_s, points[:, [i, j]], colours)
            _draw_axes(axis, T, points, (i, j))
            axis.set_xlabel("xyz"[i] + " (mm)")
            axis.set_ylabel("xyz"[j] + " (mm)")
            axis.set_aspect("equal", adjustable="datalim")
            # A path straight along the view has no extent of its own.
            axis.update_datalim([points[0, [i, j]] - _LEAST_EXTENT_MM, points[0, [i, j]] + _LEAST_EXTENT_MM])
            axis.grid(alpha=0.3)
    axes[0].set_title("from the side; ticks show the sensor's axis as far as its tip")
    axes[1].set_title("from above")
    handles = [Line2D([], [], color=colour, lw=2, label=state) for state, colour in colours.items()]
    axes[0].legend(handles=handles, fontsize=9, loc="best")
    figure.savefig(path, dpi=100)
    return path


def plot_budget(stages_ms: Mapping[str, Array], path: Path, title: str) -> Path:
    """Plot median and 99th percentile of the duration of each stage, as bars in the given order."""
    figure = Figure(figsize=(9, 0.5 * len(stages_ms) + 1.5), layout="constrained")
    axis = figure.subplots()
    position = np.arange(len(stages_ms))
    for percentile, colour in ((99, "#c6d3ea"), (50, "#4c72b0")):
        widths = [float(np.percentile(times, percentile)) for times in stages_ms.values()]
        axis.barh(position, widths, color=colour, label="median" if percentile == 50 else "p99")
    axis.set_yticks(position, list(stages_ms))
    axis.invert_yaxis()
    axis.set_xlabel("ms")
    axis.set_title(title)
    axis.legend()
    axis.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=110)
    return path


def _states(run: Run) -> list[str]:
    task = run.series("/task")
    return list(dict.fromkeys(str(row.get("state")) for row in task.rows)) if task is not None else ["run"]


def _draw_path(axis: Axes, run: Run, t_s: Array, points: Array, colours: dict[str, str]) -> None:
    for state, colour in colours.items():
        inside = run.during(t_s, state)
        shown = np.where(inside[:, None], points, np.nan)
        axis.plot(shown[:, 0], shown[:, 1], color=colour, lw=1.6)


def _draw_axes(axis: Axes, T: Array, points: Array, view: tuple[int, int]) -> None:
    ticks = np.linspace(0, len(T) - 1, 25).astype(int)
    tips = points[ticks] + _TIP_RADIUS_MM * T[ticks, :3, 2]
    for start, end in zip(points[ticks], tips, strict=True):
        axis.plot([start[view[0]], end[view[0]]], [start[view[1]], end[view[1]]], color="black", lw=0.7, alpha=0.6)


def _shade_states(axis: Axes, run: Run) -> None:
    """Shade the times at which the task was running, so that approach and retreat do not look like errors."""
    task = run.series("/task")
    if task is None:
        return
    running = np.array([row.get("state") == "run" for row in task.rows])
    axis.fill_between(
        task.t_s, 0, 1, where=running, transform=axis.get_xaxis_transform(), color="#55a868", alpha=0.07, lw=0
    )


def _limit(axis: Axes, value: Array, truth: Array) -> None:
    """Set axis limits from the values, not from the wide uncertainty at first contact."""
    finite = np.concatenate([value[np.isfinite(value)], truth[np.isfinite(truth)]])
    if len(finite):
        margin = 0.15 * max(float(np.ptp(finite)), 0.2)
        axis.set_ylim(float(finite.min()) - margin, float(finite.max()) + margin)
