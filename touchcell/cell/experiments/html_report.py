"""An experiment's report as one HTML file with interactive plots."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.html_page import plotly_graphs, write_page
from touchcell.cell.errors import RecordingError
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished
from touchcell.geometry.types import Array

_MOST_PATHS: Final = 60
_MOST_POINTS: Final = 300


def write_experiment_html(
    title: str,
    shown: Sequence[Column],
    finished: Sequence[Finished],
    text: str,
    pictures: Sequence[Path],
    folder: Path,
) -> Path:
    """Write ``report.html``: the table, each measure trial by trial, the paths of the tools, and the figures.

    Args:
        title: of the page.
        shown: columns of the table.
        finished: its trials.
        text: of its table.
        pictures: its figures.
        folder: of the experiment.

    Raises:
        ConfigError: plotly is missing.
        RecordingError: the file cannot be written.
    """
    go = plotly_graphs()
    # A table may show mean and worst of the same measure; here each trial has a point.
    columns: dict[str, Column] = {}
    for column in shown:
        first = columns.setdefault(column.measure, column)
        columns[column.measure] = replace(first, below=first.below if column.below is None else column.below)
    figures = [
        (column.title, _measure_figure(go, column, finished))
        for column in columns.values()
        if any(np.isfinite(each.measures.get(column.measure, np.nan)) for each in finished)
    ]
    if paths := list(_paths(finished)):
        figures.append(("Where the tools went", _paths_figure(go, paths)))
    after = [_trials_table(shown, finished), *map(_inlined, pictures)]
    return write_page(folder, title, text, figures, after)


def _measure_figure(go: Any, column: Column, finished: Sequence[Finished]) -> Any:
    """Return one measure with a point for each trial, by row of the table."""
    figure = go.Figure()
    for row in dict.fromkeys(each.trial.row for each in finished):
        mine = [each for each in finished if each.trial.row == row]
        values = [each.measures.get(column.measure, np.nan) for each in mine]
        figure.add_trace(
            go.Box(
                x=values,
                name=row,
                text=[f"{each.trial.name}: {each.outcome}" for each in mine],
                boxpoints="all",
                jitter=0.4,
                pointpos=0.0,
                fillcolor="rgba(76,114,176,.15)",
                line={"color": "#4c72b0", "width": 1},
                marker={"size": 6},
                hovertemplate="%{text}<br>%{x:.4g}<extra></extra>",
            )
        )
    if column.below is not None:
        figure.add_vline(x=column.below, line={"color": "#c44e52", "dash": "dash"}, annotation_text="aim: below")
    rows = len(figure.data)
    figure.update_layout(
        height=120 + 42 * rows, xaxis_title=column.title, showlegend=False, margin={"t": 20, "l": 10, "b": 50}
    )
    figure.update_yaxes(autorange="reversed", automargin=True)
    return figure


def _paths(finished: Sequence[Finished]) -> Iterator[tuple[Finished, str, Array]]:
    """Yield trial, role of the arm, and (n, 3) positions of its tool in its base frame, in mm."""
    for each in finished[:: max(1, -(-len(finished) // _MOST_PATHS))]:
        try:
            run = each.folder.recording
        except RecordingError:
            # A trial that ended before it could record.
            continue
        for role in run.roles("arms", "tcp"):
            series = run.series(f"/arms/{role}/tcp")
            if series is not None and len(series.t_s):
                points = series.poses()[:: max(1, -(-len(series.t_s) // _MOST_POINTS)), :3]
                yield each, role, points


def _paths_figure(go: Any, paths: Sequence[tuple[Finished, str, Array]]) -> Any:
    """Return the paths in three dimensions; a row of the table is shown or hidden as one."""
    colours = ("#4c72b0", "#dd8452", "#55a868", "#c44e52", "#8172b3", "#937860", "#da8bc3", "#8c8c8c")
    rows = list(dict.fromkeys(each.trial.row for each, _, _ in paths))
    figure, shown = go.Figure(), set[str]()
    for each, role, points in paths:
        row = each.trial.row
        x, y, z = np.round(points, 2).T.tolist()
        figure.add_trace(
            go.Scatter3d(
                x=x,
                y=y,
                z=z,
                mode="lines",
                name=row,
                legendgroup=row,
                showlegend=row not in shown,
                line={"color": colours[rows.index(row) % len(colours)], "width": 3},
                hovertemplate=f"{each.trial.name}, {role}<br>%{{x:.1f}}, %{{y:.1f}}, %{{z:.1f}} mm<extra></extra>",
            )
        )
        shown.add(row)
    eye = {"x": 1.3, "y": -2.2, "z": 1.2}
    scene = {
        "aspectmode": "data",
        "camera": {"eye": eye},
        "xaxis_title": "x (mm)",
        "yaxis_title": "y (mm)",
        "zaxis_title": "z (mm)",
    }
    figure.update_layout(height=640, scene=scene, margin={"l": 0, "r": 0, "t": 20, "b": 0}, legend={"y": 0.98})
    return figure


def _trials_table(columns: Sequence[Column], finished: Sequence[Finished]) -> str:
    """Return every trial with its outcome, its measures and its run folder."""
    head = "".join(f"<th>{html.escape(title)}</th>" for title in ("trial", "outcome", *(c.title for c in columns)))
    rows = []
    for each in finished:
        values = (each.measures.get(column.measure, float("nan")) for column in columns)
        cells = "".join(f"<td>{value:.{column.digits}f}</td>" for value, column in zip(values, columns, strict=True))
        name, why = html.escape(each.trial.name), html.escape(each.reason)
        link = f"<a href='trials/{name}/'>{name}</a>"
        rows.append(f"<tr><td>{link}</td><td title='{why}'>{html.escape(each.outcome)}</td>{cells}</tr>")
    return f"<h2>Trials</h2><table><tr>{head}</tr>{''.join(rows)}</table>"


def _inlined(picture: Path) -> str:
    data = base64.b64encode(picture.read_bytes()).decode()
    kind = picture.suffix.removeprefix(".")
    return f"<h2>{html.escape(picture.stem.replace('_', ' '))}</h2><img src='data:image/{kind};base64,{data}'>"
