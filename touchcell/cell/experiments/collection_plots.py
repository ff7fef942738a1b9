"""Plot of collected samples."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from touchcell.cell.experiments.frames import save
from touchcell.drivers.replay.dataset import Split, read_image


def plot_samples(split: Split, path: Path, *, count: int = 8) -> Path:
    """Plot the first frames of a split with their labels."""
    figure, axes = plt.subplots(2, count // 2, figsize=(2.6 * count // 2, 6), layout="constrained")
    for axis, image, label in zip(axes.flat, split.images, split.contact_mm_deg, strict=False):
        axis.imshow(read_image(image), cmap="gray")
        x, y, z, alpha, beta, gamma = label
        axis.set_title(
            f"z {z:.1f} mm, shear {x:.1f} {y:.1f} mm\ntilt {alpha:.0f} {beta:.0f}°, twist {gamma:.0f}°", fontsize=8
        )
        axis.set_axis_off()
    return save(figure, path)
