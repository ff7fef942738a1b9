"""Plots of a run. Imported only when needed, because matplotlib is heavy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from touchcell.cell.analysis.run_data import Run, tip_points
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.scene.description import ARM_COLOURS, Part, SceneDescription
from touchcell.cell.scene.frames import object_frame
from touchcell.geometry.solids import triangulated
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
_OBJECT_COLOUR, _TARGET_COLOUR = "#937860", "#d62728"


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
        _limit(axis, value, truth.column(name) if truth is not None else value, 2 * sigma)
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


def plot_trajectory(
    run: Run, path: Path, mounts: Mapping[str, tuple[Array, Array]], scene: SceneDescription | None = None
) -> Path:
    """Plot the paths of the arms' sensors and of objects in side and top view, with the target and the planned path.

    Args:
        run: its recording.
        path: PNG to write.
        mounts: by arm, the poses (4, 4) of its base in the world and of its sensor in its tool; None means that both
            are the identity.
        scene: what the cell looks like, for objects, target and path.
    """
    figure = Figure(figsize=(15, 6), layout="constrained")
    axes = figure.subplots(1, 2)
    paths: dict[str, tuple[Array, Array]] = {}
    order = {arm: k for k, arm in enumerate(mounts)}
    for arm in sorted(run.roles("arms", "tcp"), key=lambda each: order.get(each, len(order))):
        series = run.series(f"/arms/{arm}/tcp")
        assert series is not None
        T_world_base, T_tcp_sensor = mounts.get(arm, (np.eye(4), np.eye(4)))
        paths[arm] = series.t_s, T_world_base @ tip_points(series) @ T_tcp_sensor
    every = np.concatenate([T[:, :2, 3] for _, T in paths.values()]) if paths else np.zeros((1, 2))
    # The side view is along the horizontal axis in which the paths are narrowest.
    along = int(np.argmax(np.ptp(every, axis=0)))
    for axis, view in zip(axes, ((along, 2), (0, 1)), strict=True):
        if scene is not None:
            _draw_scene(axis, run, scene, view)
        for k, (arm, (t_s, T)) in enumerate(paths.items()):
            colour = ARM_COLOURS[k % len(ARM_COLOURS)][:3]
            points = 1e3 * T[:, :3, 3]
            running = run.during(t_s, "run")
            axis.plot(*points[:, list(view)].T, color=colour, lw=0.9, ls=":")
            axis.plot(*np.where(running[:, None], points[:, list(view)], np.nan).T, color=colour, lw=2.0, label=arm)
            axis.plot(*points[0, list(view)], "o", ms=5, color=colour)
            _draw_axes(axis, T, points, view)
            # A path straight along the view has no extent of its own.
            axis.update_datalim([points[0, list(view)] - _LEAST_EXTENT_MM, points[0, list(view)] + _LEAST_EXTENT_MM])
        axis.set_xlabel("xyz"[view[0]] + " (mm)")
        axis.set_ylabel("xyz"[view[1]] + " (mm)")
        axis.set_aspect("equal", adjustable="datalim")
        axis.grid(alpha=0.3)
    axes[0].set_title("from the side; ticks show the sensor's axis as far as its tip")
    axes[1].set_title("from above")
    axes[1].legend(fontsize=9, loc="best", title="solid while the task runs, dot at the start", title_fontsize=8)
    figure.savefig(path, dpi=100)
    return path


def plot_budget(stages_ms: Mapping[str, Array], path: Path, title: str, budget_ms: float | None = None) -> Path:
    """Plot median and 99th percentile of the duration of each stage, as bars in the given order, and their budget."""
    figure = Figure(figsize=(9, 0.5 * len(stages_ms) + 1.5), layout="constrained")
    axis = figure.subplots()
    position = np.arange(len(stages_ms))
    for percentile, colour in ((99, "#c6d3ea"), (50, "#4c72b0")):
        widths = [float(np.percentile(times, percentile)) for times in stages_ms.values()]
        axis.barh(position, widths, color=colour, label="median" if percentile == 50 else "p99")
    if budget_ms is not None:
        axis.axvline(budget_ms, color="#c44e52", lw=1.4, ls="--", label=f"one cycle: {budget_ms:g} ms")
    axis.set_yticks(position, list(stages_ms))
    axis.invert_yaxis()
    axis.set_xlabel("ms")
    axis.set_title(title)
    axis.legend()
    axis.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=110)
    return path


def _draw_scene(axis: Axes, run: Run, scene: SceneDescription, view: tuple[int, int]) -> None:
    """Draw objects where they began and ended, the way between, the target and the planned path."""
    for topic, series in run.topics.items():
        if not topic.startswith("/objects/"):
            continue
        name, poses = topic.rpartition("/")[2], tip_points(series)
        parts = [part for part in scene.parts if part.frame == object_frame(name)]
        points = np.concatenate([_points(part) for part in parts]) if parts else np.zeros((1, 3))
        for T, style, label in ((poses[0], ":", None), (poses[-1], "-", name)):
            outline = _outline(1e3 * (points @ T[:3, :3].T + T[:3, 3])[:, list(view)])
            axis.plot(*outline.T, color=_OBJECT_COLOUR, lw=1.2, ls=style, label=label)
        axis.plot(*(1e3 * poses[:, list(view), 3]).T, color=_OBJECT_COLOUR, lw=1.0)
    if scene.path is not None:
        axis.plot(*(1e3 * scene.path[:, list(view)]).T, color=_TARGET_COLOUR, lw=1.0, ls="--", label="planned path")
    if scene.target is not None:
        place = 1e3 * scene.target[list(view)]
        axis.plot(*place, "o", ms=10, mfc="none", mec=_TARGET_COLOUR, mew=1.5, ls="none", label="target")


def _points(part: Part) -> Array:
    vertices = triangulated(part.solid).vertices_m
    placed: Array = vertices @ part.T_frame_solid[:3, :3].T + part.T_frame_solid[:3, 3]
    return placed


def _outline(points: Array) -> Array:
    import cv2

    hull = cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)
    return np.concatenate([hull, hull[:1]])


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


def _limit(axis: Axes, value: Array, truth: Array, band: Array) -> None:
    """Set axis limits that hold values, truth and the usual band; that of the first contact is wider for a moment."""
    edges = np.concatenate([value - band, value + band])
    edges = edges[np.isfinite(edges)]
    finite = np.concatenate([value[np.isfinite(value)], truth[np.isfinite(truth)]])
    if len(finite):
        usual = np.percentile(edges, [3, 97]) if len(edges) else finite[:0]
        shown = np.concatenate([finite, usual])
        margin = 0.1 * max(float(np.ptp(shown)), 0.2)
        axis.set_ylim(float(shown.min()) - margin, float(shown.max()) + margin)
