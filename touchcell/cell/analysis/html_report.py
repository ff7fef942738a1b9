"""A run's report as one HTML file with interactive plots. Imported only when wanted, because plotly is heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.frame_poses import frame_poses
from touchcell.cell.analysis.html_page import plotly_graphs, write_page
from touchcell.cell.analysis.limits import WatchedQuantity, watched_quantities
from touchcell.cell.analysis.run_data import STAGES, Run
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.scene.description import SceneDescription, describe_scene
from touchcell.cell.scene.frames import WORLD
from touchcell.geometry.solids import Polyline, triangulated
from touchcell.geometry.types import Array

_PICTURES: Final = 40
_MOST_POINTS: Final = 2000


def write_html(folder: Path) -> Path:
    """Write ``report.html`` into a run folder: summary, scene over time, contacts, limits and durations.

    Raises:
        ConfigError: plotly is missing, or the run's cell file cannot be read.
        RecordingError: the folder holds no recording, or it cannot be written.
    """
    go = plotly_graphs()
    source = RunFolder(folder)
    run, plan = source.recording, source.plan
    figures: list[tuple[str, Any]] = [("The cell", _scene_figure(go, source, describe_scene(plan)))]
    figures += [
        (f"Contact of {sensor}", _contact_figure(go, run, sensor)) for sensor in run.roles("sensors", "contact")
    ]
    if rows := [each for each in watched_quantities(run, plan) if each.closest() is not None]:
        figures.append(("Distance to limits", _limits_figure(go, rows)))
    if (timing := _timing_figure(go, run, plan)) is not None:
        figures.append(("Duration of a cycle's stages", timing))
    summary = folder / "summary.txt"
    text = summary.read_text() if summary.exists() else ""
    return write_page(folder, plan.cell.name, text, figures)


def _scene_figure(go: Any, source: RunFolder, scene: SceneDescription) -> Any:
    """Return the cell in three dimensions with a slider over time."""
    run = source.recording
    end_s = max((float(series.t_s[-1]) for series in run.topics.values() if len(series.t_s)), default=0.0)
    times_s = np.linspace(0.0, end_s, _PICTURES)
    poses = frame_poses(run, scene, times_s)
    moving = [k for k, part in enumerate(scene.parts) if part.frame in poses and len(poses[part.frame]) > 1]
    drawn = [k for k, part in enumerate(scene.parts) if part.frame in poses]
    still = [k for k in drawn if k not in moving]
    order = still + moving
    figure = go.Figure([_part_trace(go, scene, k, poses, 0) for k in order])
    figure.frames = [
        go.Frame(
            name=f"{t_s:.2f}",
            data=[_part_trace(go, scene, k, poses, i) for k in moving],
            traces=list(range(len(still), len(order))),
        )
        for i, t_s in enumerate(times_s)
    ]
    steps = [
        {
            "label": frame.name,
            "method": "animate",
            "args": [[frame.name], {"mode": "immediate", "frame": {"duration": 0}}],
        }
        for frame in figure.frames
    ]
    play = {"label": "play", "method": "animate", "args": [None, {"frame": {"duration": 120}, "fromcurrent": True}]}
    figure.update_layout(
        height=650,
        scene={"aspectmode": "data", "xaxis_title": "x (m)", "yaxis_title": "y (m)", "zaxis_title": "z (m)"},
        sliders=[{"steps": steps, "currentvalue": {"prefix": "t = ", "suffix": " s"}}],
        updatemenus=[{"type": "buttons", "buttons": [play], "x": 0.0, "y": 1.05}],
        showlegend=False,
        margin={"l": 0, "r": 0, "t": 30, "b": 0},
    )
    return figure


def _part_trace(go: Any, scene: SceneDescription, number: int, poses: dict[str, Array], i: int) -> Any:
    part = scene.parts[number]
    along = poses[part.frame]
    T = (along[min(i, len(along) - 1)] if part.frame != WORLD else np.eye(4)) @ part.T_frame_solid
    mesh = triangulated(part.solid, around=16)
    x, y, z = np.round(mesh.vertices_m @ T[:3, :3].T + T[:3, 3], 4).T.tolist()
    red, green, blue, opacity = part.colour
    colour = f"rgb({255 * red:.0f},{255 * green:.0f},{255 * blue:.0f})"
    if isinstance(part.solid, Polyline):
        line = {"color": colour, "width": 4}
        return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=line, opacity=opacity, name=part.name)
    a, b, c = mesh.triangles.T.tolist()
    return go.Mesh3d(x=x, y=y, z=z, i=a, j=b, k=c, color=colour, opacity=opacity, flatshading=True, name=part.name)


def _contact_figure(go: Any, run: Run, sensor: str) -> Any:
    from plotly.subplots import make_subplots

    contact, truth = run.series(f"/sensors/{sensor}/contact"), run.series(f"/sensors/{sensor}/truth")
    assert contact is not None
    figure = make_subplots(rows=2, cols=3, shared_xaxes=True, subplot_titles=COMPONENTS)
    kept = _kept(len(contact.t_s))
    for k, name in enumerate(COMPONENTS):
        place = {"row": 1 + k // 3, "col": 1 + k % 3}
        value, band = contact.column(name)[kept], 2 * contact.column(f"sigma_{name}")[kept]
        t_s = contact.t_s[kept]
        edge = {"mode": "lines", "line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}
        figure.add_trace(go.Scatter(x=t_s, y=value + band, **edge), **place)
        figure.add_trace(
            go.Scatter(x=t_s, y=value - band, fill="tonexty", fillcolor="rgba(76,114,176,.2)", **edge), **place
        )
        figure.add_trace(
            go.Scatter(x=t_s, y=value, name="estimate ± 2σ", line={"color": "#4c72b0"}, showlegend=k == 0), **place
        )
        if truth is not None:
            some = _kept(len(truth.t_s))
            figure.add_trace(
                go.Scatter(
                    x=truth.t_s[some],
                    y=truth.column(name)[some],
                    name="true",
                    line={"color": "#dd8452"},
                    showlegend=k == 0,
                ),
                **place,
            )
    figure.update_layout(height=560, margin={"t": 40})
    return figure


def _limits_figure(go: Any, rows: list[WatchedQuantity]) -> Any:
    figure = go.Figure()
    for each in rows:
        if each.distance:
            continue
        kept = _kept(len(each.t_s))
        figure.add_trace(
            go.Scatter(
                x=each.t_s[kept],
                y=100 * each.values[kept] / each.limit,
                name=f"{each.interlock}: {each.title} of {each.subject}",
            )
        )
    figure.add_hline(y=100, line={"color": "#c44e52", "dash": "dash"})
    figure.update_layout(height=420, yaxis_title="% of the limit", xaxis_title="time (s)", margin={"t": 20})
    return figure


def _timing_figure(go: Any, run: Run, plan: CellPlan) -> Any:
    timing = run.series("/timing")
    if timing is None:
        return None
    figure = go.Figure()
    for stage in STAGES:
        values = 1e-3 * timing.column(f"{stage}_us")
        values = values[np.isfinite(values)]
        if len(values):
            figure.add_trace(go.Box(x=values[_kept(len(values))], name=stage.replace("_", " "), boxpoints=False))
    figure.add_vline(x=1e3 / plan.cell.rate_hz, line={"color": "#c44e52", "dash": "dash"}, annotation_text="one cycle")
    figure.update_layout(height=420, xaxis_title="ms", showlegend=False, margin={"t": 20})
    return figure


def _kept(count: int) -> slice:
    """Return what keeps at most so many points that a browser stays quick."""
    return slice(None, None, max(1, count // _MOST_POINTS))
