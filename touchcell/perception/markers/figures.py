"""Figures of markers: their displacement and the change of their density in a contact."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from touchcell.geometry.types import Array, ImageArray

_CELL_PX = 4
_BANDWIDTH_SPACINGS = 0.8


def density_change(positions: Array, reference: Array, size: tuple[int, int], spacing_px: float) -> Array:
    """Return the kernel density of markers relative to that of the undeformed tip (Lloyd & Lepora 2024, 5.1).

    Args:
        positions: (m, 2) px.
        reference: (m, 2) px, undeformed.
        size: (height, width) px of the image.
        spacing_px: of neighbouring markers; the Gaussian kernel's standard deviation is 0.8 of it.

    Returns:
        One value for each 4x4 px: -1 where no markers are left, 1 for twice as many, 0 where there were none at all.
    """
    height, width = (-(-side // _CELL_PX) for side in size)
    now, before = (_density(points, (height, width), spacing_px) for points in (positions, reference))
    floor = 0.2 * float(before.max())
    change: Array = np.where(before > floor, now / np.maximum(before, floor) - 1.0, 0.0)
    return change


def _density(points: Array, cells: tuple[int, int], spacing_px: float) -> Array:
    counts = np.zeros(cells)
    u, v = np.floor(points / _CELL_PX).astype(int).T
    inside = (u >= 0) & (u < cells[1]) & (v >= 0) & (v < cells[0])
    np.add.at(counts, (v[inside], u[inside]), 1.0)
    blurred = cv2.GaussianBlur(counts, (0, 0), _BANDWIDTH_SPACINGS * spacing_px / _CELL_PX)
    return np.asarray(blurred, dtype=np.float64)


def write_markers(
    path: Path,
    reference: Array,
    positions: Sequence[Array],
    titles: Sequence[str],
    size: tuple[int, int],
    spacing_px: float,
) -> None:
    """Write a figure with one column per contact: displacement arrows above, change of density below.

    Args:
        path: PNG to write.
        reference: (m, 2) px, undeformed.
        positions: (m, 2) px of each contact.
        titles: of the columns.
        size: (height, width) px of the images.
        spacing_px: of neighbouring markers.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(positions), 8), layout="constrained")
    panels = figure.subplots(2, len(positions), squeeze=False)
    for column, (points, title) in enumerate(zip(positions, titles, strict=True)):
        arrows, density = panels[0, column], panels[1, column]
        u, v = reference.T
        moved = points - reference
        arrows.quiver(u, v, *moved.T, np.hypot(*moved.T), angles="xy", scale_units="xy", scale=1.0, cmap="viridis")
        arrows.set(title=title, xlim=(0, size[1]), ylim=(size[0], 0), aspect="equal")
        drawn = density.imshow(
            density_change(points, reference, size, spacing_px),
            extent=(0, size[1], size[0], 0),
            cmap="RdBu_r",
            vmin=-1.0,
            vmax=1.0,
        )
    figure.colorbar(drawn, ax=list(panels[1]), label="change of marker density")
    figure.savefig(path, dpi=90)


def draw_contact(
    image: ImageArray, reference: Array, positions: Array, spacing_px: float, *, arrows: bool
) -> ImageArray:
    """Draw a live contact image: the camera image with displacement arrows, and beside it the change of density.

    Args:
        image: uint8 (height, width), the image in which the markers were detected.
        reference: (m, 2) px, undeformed.
        positions: (m, 2) px now.
        spacing_px: of neighbouring markers.
        arrows: True if the positions are those of the same markers; density needs no such order.

    Returns:
        uint8 (height, 2 width, 3) BGR; red where density rises, blue where it falls.
    """
    height, width = image.shape
    left = np.asarray(cv2.cvtColor(image // 2, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if arrows:
        whole = [(int(u), int(v)) for u, v in np.round(reference * 16)]
        ends = [(int(u), int(v)) for u, v in np.round(positions * 16)]
        for start, end in zip(whole, ends, strict=True):
            cv2.arrowedLine(left, start, end, (80, 220, 255), 1, cv2.LINE_AA, shift=4, tipLength=0.3)
    change = np.clip(density_change(positions, reference, image.shape, spacing_px), -1.0, 1.0)[..., None]
    colour = np.where(change > 0.0, [40.0, 24.0, 178.0], [172.0, 102.0, 33.0])
    drawn = 247.0 + np.abs(change) * (colour - 247.0)
    right = cv2.resize(drawn.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.concatenate([left, np.asarray(right, dtype=np.uint8)], axis=1)
