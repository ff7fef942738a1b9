"""Plots of ``touchcell bench perception``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from touchcell.perception.networks.scores import SCORE_NAMES

_MARKERS = {"onnxruntime": "o", "opencv": "v", "openvino": "s", "torch": "^", "own": "D"}


def write_run_time_against_error(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Plot the MAE of each component over CPU time per camera frame, one point for each estimator and runtime."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import StrMethodFormatter

    figure = Figure(figsize=(14, 8), layout="constrained")
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    for axes, component in zip(figure.subplots(2, 3).flat, SCORE_NAMES, strict=True):
        for row in rows:
            axes.plot(
                row["latency_ms"]["cpu"]["median"],
                row["all"]["mae"][component],
                _MARKERS[row["runtime"]],
                color=f"C{names.index(row['estimator'])}",
                label=f"{row['estimator']}, {row['runtime']}",
                ms=8,
            )
        axes.set(xscale="log", yscale="log", title=component, xlabel="ms CPU per 640x480 frame", ylabel="MAE")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(StrMethodFormatter("{x:g}"))
        axes.grid(alpha=0.3, which="both")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle("Run time against error: one point for each estimator and runtime, one thread")
    figure.savefig(path, dpi=110)


def write_reliability(path: Path, probabilities: Sequence[float], rows: Sequence[Mapping[str, Any]]) -> None:
    """Plot the fraction of labels inside the predicted central intervals over their nominal probability."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8.5), layout="constrained")
    first = {row["estimator"]: row for row in reversed(rows)}
    for axes, component in zip(figure.subplots(2, 3).flat, SCORE_NAMES, strict=True):
        axes.plot([0, 1], [0, 1], color="black", lw=0.8)
        for name, row in reversed(first.items()):
            axes.plot(probabilities, row["reliability"][component], "o-", ms=3, label=name)
        axes.set(title=component, xlabel="promised", ylabel="found", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    figure.suptitle("Reliability of the predicted sigmas: above the line too wide, below it overconfident")
    figure.savefig(path, dpi=110)
