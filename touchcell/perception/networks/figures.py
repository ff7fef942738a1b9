"""Figures of a training: predictions over labels, and learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from touchcell.geometry.types import Array
from touchcell.perception.models.labels import CONTACT_NAMES, XI_UNITS
from touchcell.perception.networks.checkpoint import EpochRecord

_TITLES = ("x (mm)", "y (mm)", "z (mm)", "α (deg)", "β (deg)", "γ (deg)")


def write_predictions(path: Path, *, truth: Array, predicted: Array, sigma: Array) -> None:
    """Plot predictions over labels, one panel per component, coloured by precision (one over the predicted sigma).

    Args:
        path: PNG to write.
        truth: (n, 6) contacts, mm and degrees.
        predicted: (n, 6) likewise.
        sigma: (n, 6) predicted standard deviations of xi, m and rad.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8), layout="constrained")
    errors = abs(predicted - truth).mean(axis=0)
    for i, axes in enumerate(figure.subplots(2, 3).flat):
        precision = XI_UNITS[i] / sigma[:, i]
        order = precision.argsort()[::-1]
        points = axes.scatter(truth[order, i], predicted[order, i], c=precision[order], s=5, cmap="viridis", lw=0)
        ends = [truth[:, i].min(), truth[:, i].max()]
        axes.plot(ends, ends, color="tab:red", lw=1)
        axes.set(title=f"{_TITLES[i]}: MAE {errors[i]:.3f}", xlabel="true", ylabel="predicted")
        axes.set_aspect("equal", adjustable="datalim")
        figure.colorbar(points, ax=axes, label="precision 1/σ")
    figure.suptitle(f"Contact pose and shear, {len(truth)} validation images")
    figure.savefig(path, dpi=110)


def write_curves(path: Path, history: Sequence[EpochRecord]) -> None:
    """Plot loss, and validation error of every component relative to its first epoch, over epochs."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    figure = Figure(figsize=(12, 4.5), layout="constrained")
    losses, errors = figure.subplots(1, 2)
    epochs = [record.epoch for record in history]
    losses.plot(epochs, [record.train_loss for record in history], label="training (with dropout and jitter)")
    losses.plot(epochs, [record.validation_loss for record in history], label="validation")
    losses.set(xlabel="epoch", ylabel="loss (nats, label half-ranges)")
    losses.legend()
    for name, title in zip(CONTACT_NAMES, _TITLES, strict=True):
        errors.plot(epochs, [record.mae[name] for record in history], label=title)
    errors.set(xlabel="epoch", ylabel="validation MAE", yscale="log")
    for formatted in (errors.yaxis.set_major_formatter, errors.yaxis.set_minor_formatter):
        formatted(StrMethodFormatter("{x:g}"))
    errors.legend(ncols=2)
    for axes in (losses, errors):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
