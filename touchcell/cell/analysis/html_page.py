"""Reports as one HTML file: text, interactive plots, and the library that draws them, inside."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from touchcell.cell.errors import RecordingError
from touchcell.errors import ConfigError

REPORT: Final = "report.html"
_STYLE: Final = (
    "body{font-family:sans-serif;max-width:1200px;margin:2em auto;padding:0 1em}"
    "pre{background:#f4f4f4;padding:1em;overflow-x:auto}img{max-width:100%}"
    "table{border-collapse:collapse;font-size:.9em;display:block;overflow-x:auto}"
    "td,th{padding:.25em .7em;border-bottom:1px solid #ddd;text-align:right}"
    "td:first-child,th:first-child{text-align:left}"
)


def plotly_graphs() -> Any:
    """Return ``plotly.graph_objects``. Raises ConfigError where plotly is missing."""
    try:
        import plotly.graph_objects as go
    except ModuleNotFoundError:
        raise ConfigError(
            "needs plotly, which is not installed", key="--html", hint="pip install 'touchcell[html]'"
        ) from None
    return go


def write_page(
    folder: Path, title: str, text: str, figures: Sequence[tuple[str, Any]], after: Sequence[str] = ()
) -> Path:
    """Write ``report.html`` into a folder, and return its path.

    Args:
        folder: where.
        title: of the page.
        text: at its top, in a fixed-width font.
        figures: titles and plotly figures.
        after: HTML below them.

    Raises:
        RecordingError: the file cannot be written.
    """
    from plotly.offline import get_plotlyjs

    parts = [
        f"<h2>{html.escape(name)}</h2>" + figure.to_html(full_html=False, include_plotlyjs=False)
        for name, figure in figures
    ]
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8>"
        f"<meta name=viewport content='width=device-width, initial-scale=1'><title>{html.escape(title)}</title>"
        f"<style>{_STYLE}</style><script>{get_plotlyjs()}</script><h1>{html.escape(title)}</h1>"
        f"<pre>{html.escape(text)}</pre>{''.join(parts)}{''.join(after)}</html>"
    )
    target = folder / REPORT
    try:
        target.write_text(page)
    except OSError as error:
        raise RecordingError(target, f"cannot be written: {error.strerror}") from None
    return target
