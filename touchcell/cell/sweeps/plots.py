"""Plots of a sweep: each measure over each factor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def draw_factors(
    rows: Sequence[Mapping[str, Any]], keys: Sequence[str], measures: Sequence[str], folder: Path
) -> list[Path]:
    """Draw one picture for each of ``measures``: its value in each trial over each factor, and the mean.

    Factors that take one value, and measures that no trial has, are left out.
    """
    varied = [key for key in keys if len({str(row.get(key)) for row in rows}) > 1]
    drawn = []
    for name in measures:
        having = [row for row in rows if row.get(name) is not None]
        if not varied or not having:
            continue
        figure = Figure(figsize=(4.0 * len(varied) + 1.0, 4.0), layout="constrained")
        axes = figure.subplots(1, len(varied), sharey=True, squeeze=False)[0]
        for axis, key in zip(axes, varied, strict=True):
            _draw(axis, having, key, name)
        axes[0].set_ylabel(name)
        drawn.append(folder / f"{name.replace('/', '_')}.png")
        figure.savefig(drawn[-1], dpi=100)
    return drawn


def _draw(axis: Axes, rows: Sequence[Mapping[str, Any]], key: str, name: str) -> None:
    values = [row[key] for row in rows]
    measured = np.array([float(row[name]) for row in rows])
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    levels = sorted(set(values)) if numeric else list(dict.fromkeys(map(str, values)))
    where = np.array(values, dtype=float) if numeric else np.array([levels.index(str(value)) for value in values])
    axis.plot(where, measured, ".", color="tab:blue", alpha=0.5)
    if len(levels) < len(rows):
        at = levels if numeric else list(range(len(levels)))
        axis.plot(at, [measured[where == each].mean() for each in at], "-", color="black", label="mean")
        axis.legend()
    if not numeric:
        axis.set_xticks(range(len(levels)), levels, rotation=20)
    axis.set_xlabel(key)
