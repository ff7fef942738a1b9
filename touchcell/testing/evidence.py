"""Evidence of hardware-in-the-loop tests: one self-contained HTML page, with a plot for each test that moved a cell."""

from __future__ import annotations

import base64
import getpass
import hashlib
import html
import io
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from touchcell.cell.analysis.provenance import provenance

if TYPE_CHECKING:
    from touchcell.testing.cell_under_test import CellUnderTest

_STYLE = (
    "body{font:15px sans-serif;margin:2em auto;max-width:60em}table{border-collapse:collapse;width:100%}"
    "td,th{border:1px solid #ccc;padding:.3em .6em;text-align:left;vertical-align:top}"
    ".passed{background:#e5f5e5}.failed{background:#fbe0e0}.skipped{background:#eee}img{max-width:100%}pre{white-space:pre-wrap}"
)


@dataclass(frozen=True)
class _Row:
    name: str
    what: str
    outcome: str
    duration_s: float
    facts: str
    trouble: str
    picture: bytes


@dataclass
class Evidence:
    """What the tests of one session have shown.

    Attributes:
        world: where they ran.
    """

    world: str
    _rows: list[_Row] = field(default_factory=list)
    _cells: dict[Path, str] = field(default_factory=dict)

    def add(self, name: str, what: str, report: Any, cell: Path, running: CellUnderTest | None) -> None:
        """Add one test.

        Args:
            name: of the test.
            what: it shows, for people.
            report: pytest's.
            cell: its cell file.
            running: the cell that it has run; None where it has not.
        """
        self._cells.setdefault(cell, "" if running is None else running.plan.text())
        trouble = "" if report.passed else str(report.longreprtext)
        self._rows.append(
            _Row(
                name.split("::", 1)[-1],
                what.strip(),
                report.outcome,
                report.duration,
                "" if running is None else _facts(running),
                trouble,
                b"" if running is None else _picture(running),
            )
        )

    def write(self, path: Path) -> None:
        """Write the page."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self._page(), encoding="utf-8")

    def _page(self) -> str:
        about = {
            "world": self.world,
            "when": time.strftime("%Y-%m-%d %H:%M:%S %z"),
            "who": f"{getpass.getuser()} at {socket.gethostname()}",
            **{key: str(value) for key, value in provenance().items()},
            **{str(file): f"sha256 {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in self._cells},
        }
        counts = {kind: sum(row.outcome == kind for row in self._rows) for kind in ("passed", "failed", "skipped")}
        parts = [
            "<!doctype html><meta charset='utf-8'><title>Hardware-in-the-loop tests</title>",
            f"<style>{_STYLE}</style><h1>Hardware-in-the-loop tests</h1>",
            f"<p>{', '.join(f'{count} {kind}' for kind, count in counts.items())}</p><table>",
            *(f"<tr><th>{html.escape(key)}</th><td>{html.escape(value)}</td></tr>" for key, value in about.items()),
            "</table><h2>Tests</h2><table>",
            *(_html(row) for row in self._rows),
            "</table>",
            *(
                f"<h2>{html.escape(file.name)}, as it ran</h2><pre>{html.escape(text)}</pre>"
                for file, text in self._cells.items()
            ),
        ]
        return "\n".join(parts)


def _html(row: _Row) -> str:
    data = base64.b64encode(row.picture).decode()
    shown = f"<img alt='speeds of the tools over time' src='data:image/png;base64,{data}'>"
    return (
        f"<tr class='{row.outcome}'><td>{html.escape(row.name)}<br><small>{html.escape(row.what)}</small></td>"
        f"<td>{row.outcome}<br><small>{row.duration_s:.2f} s</small></td>"
        f"<td>{html.escape(row.facts)}{f'<pre>{html.escape(row.trouble)}</pre>' if row.trouble else ''}"
        f"{shown if row.picture else ''}</td></tr>"
    )


def _facts(running: CellUnderTest) -> str:
    """Return what tripped first, and how each arm came to rest."""
    said = []
    if (cause := running.first_cause) is not None:
        said.append(f"first cause {cause.interlock}: {cause.reason}")
    for role, stop in running.stops.items():
        if stop.time_s is not None and stop.distance_m is not None:
            said.append(f"{role} at rest after {1e3 * stop.time_s:.0f} ms and {1e3 * stop.distance_m:.2f} mm")
    return "; ".join(said)


def _picture(running: CellUnderTest) -> bytes:
    """Return a PNG of the speed of each tool over time, with the trip."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 1.8), layout="constrained")
    axes = figure.add_subplot()
    for role in running.cell.arms:
        topic = f"/arms/{role}/tcp"
        rows = [(each.t_ns, each.data) for each in running.messages if each.topic == topic]
        if rows:
            t_s = (np.array([t_ns for t_ns, _ in rows]) - running.cell.start_ns) * 1e-9
            axes.plot(t_s, [data.get("speed_mm_s", np.nan) for _, data in rows], label=role)
    if (cause := running.first_cause) is not None:
        axes.axvline((cause.t_ns - running.cell.start_ns) * 1e-9, color="r", label=cause.interlock)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", fontsize="small")
    axes.set(xlabel="time, s", ylabel="tool, mm/s")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    return stream.getvalue()
