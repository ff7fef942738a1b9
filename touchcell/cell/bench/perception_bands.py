"""Whether predicted sigmas hold at every depth, with and without slip: tables and reliability plots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.perception.networks.scores import SCORE_NAMES, Scores

PROBABILITIES: Final = tuple(np.linspace(0.05, 0.95, 19).round(2).tolist())
_DEPTHS_MM: Final = (0.0, 1.5, 3.0, 4.5, np.inf)
_FEWEST: Final = 10
"""Fewer images say nothing about an interval of 95 %."""


def bands(scores: Scores) -> dict[str, Scores]:
    """Return the scores of all images, of those that slip and do not, and of each depth and both; few are left out."""
    depth, free = scores.contact_mm_deg[:, 2], scores.slip_free
    found = {"all": scores, "no slip": scores.subset(free), "slip": scores.subset(~free)}
    for low, high in pairwise(_DEPTHS_MM):
        name = f"z > {low:g} mm" if np.isinf(high) else f"z {low:g} to {high:g} mm"
        inside = (depth >= low) & (depth < high)
        found |= {f"{name}, no slip": scores.subset(inside & free), f"{name}, slip": scores.subset(inside & ~free)}
    return {name: each for name, each in found.items() if len(each) >= _FEWEST}


def summary(scores: Scores) -> dict[str, Any]:
    """Return number, errors, coverage and consistency of some images."""
    return {
        "n": len(scores),
        "mae": scores.mae(),
        "coverage": {"68": scores.coverage(0.68), "95": scores.coverage(0.95)},
        "nees": float(scores.nees.mean()),
        "joint_95": scores.joint_coverage(0.95),
        "nll": float(scores.nll.mean()),
        "reliability": scores.reliability(PROBABILITIES),
    }


def summaries(scores: Scores) -> dict[str, dict[str, Any]]:
    """Return ``summary`` of each of ``bands``."""
    return {name: summary(each) for name, each in bands(scores).items()}


def band_lines(title: str, found: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the lines of a table of ``summaries``."""
    yield f"\n{title}: labels within the 95 % interval, %; NEES (6 if consistent), joint 95 %, NLL"
    heads = "".join(f"{name:>11}" for name in SCORE_NAMES)
    yield f"{'':<22}{'images':>7}{heads}{'NEES':>8}{'joint':>8}{'NLL':>8}"
    for name, row in found.items():
        cells = "".join(f"{100.0 * row['coverage']['95'][each]:>11.1f}" for each in SCORE_NAMES)
        yield f"{name:<22}{row['n']:>7}{cells}{row['nees']:>8.2f}{100.0 * row['joint_95']:>8.1f}{row['nll']:>8.2f}"


def write_reliability_by_band(path: Path, title: str, found: Mapping[str, Mapping[str, Any]]) -> None:
    """Plot the share of labels inside the predicted intervals over what they promise, by depth and by slip."""
    from matplotlib.figure import Figure

    names: Sequence[str] = [name for name in found if name not in ("no slip", "slip")]
    depths = list(dict.fromkeys(name.removesuffix(", no slip").removesuffix(", slip") for name in names))
    figure = Figure(figsize=(13, 8.5), layout="constrained")
    for axes, component in zip(figure.subplots(2, 3).flat, SCORE_NAMES, strict=True):
        axes.plot([0, 1], [0, 1], color="black", lw=0.8)
        for name in names:
            slips = name.endswith(", slip")
            axes.plot(
                PROBABILITIES,
                found[name]["reliability"][component],
                "--" if slips else "-",
                color="0.4" if name == "all" else f"C{depths.index(name.rpartition(',')[0])}",
                lw=2.5 if name == "all" else 1.2,
                label=f"{name} ({found[name]['n']})",
            )
        axes.set(title=component, xlabel="promised", ylabel="found", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(f"{title}: above the line too wide, below it overconfident")
    figure.savefig(path, dpi=90)
