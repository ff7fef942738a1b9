"""Figures of a calibrated tip: real beside simulated images, and the remaining marker errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from touchcell.geometry.types import Array, ImageArray


def write_comparison(
    path: Path,
    real: Sequence[ImageArray],
    simulated: Sequence[ImageArray],
    measured: Sequence[Array],
    predicted: Sequence[Array],
    titles: Sequence[str],
) -> None:
    """Plot one column per contact: real image, simulated image, arrows from simulated to real markers.

    Args:
        path: PNG to write.
        real, simulated: images of one size.
        measured, predicted: (k, 2) px of detected markers, and of the same markers in the simulation.
        titles: titles of the columns.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6 * len(titles), 10.5), layout="constrained")
    rows = figure.subplots(3, len(titles), squeeze=False)
    for i, title in enumerate(titles):
        for axes, image in zip(rows[:2, i], (real[i], simulated[i]), strict=True):
            axes.imshow(image, cmap="gray", vmin=0, vmax=255)
            axes.set(xticks=[], yticks=[])
        rows[0, i].set_title(title)
        off = measured[i] - predicted[i]
        height, width = real[i].shape
        arrows = rows[2, i].quiver(
            *predicted[i].T, *off.T, np.hypot(*off.T), angles="xy", scale_units="xy", scale=0.2, cmap="viridis"
        )
        arrows.set_clim(0.0, 6.0)
        rows[2, i].set(
            xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[],
            title=f"mean {np.hypot(*off.T).mean():.2f} px (arrows 5 x)",
        )  # fmt: skip
    for axes, name in zip(rows[:, 0], ("real", "simulated", "simulated to real"), strict=True):
        axes.set_ylabel(name)
    figure.colorbar(arrows, ax=list(rows[2]), label="px")
    figure.savefig(path, dpi=80)
