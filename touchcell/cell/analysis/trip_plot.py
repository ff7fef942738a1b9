"""The plot around a trip. Imported only when needed, because matplotlib is heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from touchcell.cell.analysis.limits import WatchedQuantity
from touchcell.cell.analysis.run_data import Run

_BEFORE_S, _AFTER_S = 1.0, 0.5


def plot_trip(
    run: Run,
    trip_s: float,
    cause: dict[str, Any] | None,
    path: Path,
    moment: str = "trip",
    tripped: WatchedQuantity | None = None,
) -> Path:
    """Plot the quantity that tripped against its limit, speed sent and measured, depth, and the age of frames.

    From a second before the moment until after the stop.
    """
    rows = 3 if tripped is None else 4
    figure = Figure(figsize=(11, 2.7 * rows), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True)
    speed, depth, age = axes[-3:]
    if tripped is not None:
        _draw_against_limit(axes[0], tripped, trip_s)
    axes[-1].set_xlim(-_BEFORE_S, _AFTER_S)
    for role in run.roles("arms", "tcp"):
        tcp, sent = run.series(f"/arms/{role}/tcp"), run.series(f"/arms/{role}/command")
        assert tcp is not None
        (line,) = speed.plot(tcp.t_s - trip_s, tcp.column("speed_mm_s"), lw=1.4, label=f"{role}, measured")
        if sent is not None:
            speed.plot(
                sent.t_s - trip_s,
                sent.column("speed_mm_s"),
                ls="none",
                marker=".",
                ms=4,
                color=line.get_color(),
                label=f"{role}, sent",
            )
    for role in run.roles("sensors", "contact"):
        contact = run.series(f"/sensors/{role}/contact")
        assert contact is not None
        t_s = contact.t_s - trip_s
        depth.plot(t_s, contact.column("z_mm"), lw=1.4, label=f"{role}, estimate")
        frame_s = (contact.column("t_frame_ns") - run.start_ns) * 1e-9 - trip_s
        age.plot(t_s, 1e3 * (t_s - frame_s), lw=1.2, label=role)
        truth = run.series(f"/sensors/{role}/truth")
        if truth is not None:
            depth.plot(truth.t_s - trip_s, truth.column("z_mm"), lw=1.0, ls="--", label=f"{role}, true")
    for axis, title in zip(axes[-3:], ("tool speed (mm/s)", "depth (mm)", "age of the frame (ms)"), strict=True):
        axis.axvline(0.0, color="#c44e52", lw=1.2)
        axis.set_ylabel(title)
        axis.grid(alpha=0.3)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=9, loc="upper left")
    axes[-1].set_xlabel(f"time from the {moment} (s)")
    if cause is not None:
        figure.suptitle(f"{cause['interlock']}: {cause['subject']}: {cause['reason']}")
    figure.savefig(path, dpi=110)
    return path


def _draw_against_limit(axis: Axes, tripped: WatchedQuantity, trip_s: float) -> None:
    t_s = tripped.t_s - trip_s
    unit = f" ({tripped.unit})" if tripped.unit else ""
    axis.plot(t_s, tripped.values, lw=1.6, color="#4c72b0", label=tripped.subject)
    axis.axhline(tripped.limit, color="#c44e52", lw=1.2, ls="--", label=f"limit {tripped.limit:g}{unit}")
    shown = tripped.values[(t_s >= -_BEFORE_S) & (t_s <= _AFTER_S) & np.isfinite(tripped.values)]
    low, high = min([tripped.limit, *shown.tolist()]), max([tripped.limit, *shown.tolist()])
    margin = 0.1 * max(high - low, 1e-6)
    axis.set_ylim(low - margin, high + margin)
    axis.axvline(0.0, color="#c44e52", lw=1.2)
    axis.set_ylabel(f"{tripped.title}{unit}")
    axis.set_title(f"what tripped `{tripped.interlock}`", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9, loc="upper left")
