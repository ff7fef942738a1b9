"""Plot of a replay over its run. Imported only when needed, because matplotlib is heavy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from touchcell.cell.replaying.differences import Difference
from touchcell.cell.replaying.recorded_run import RecordedCycle, numbers
from touchcell.cell.replaying.replay import Replay
from touchcell.geometry.types import Array

_RUN, _REPLAY = "#4c72b0", "#dd8452"


def plot_replay(replay: Replay, differences: list[Difference], path: Path) -> Path:
    """Plot depth and speed of run and replay, and below each how far they are apart, with the tolerance."""
    shown = [each for each in differences if len(each.linear)]
    figure = Figure(figsize=(5 * max(len(shown), 1), 6), layout="constrained")
    axes = figure.subplots(2, max(len(shown), 1), sharex=True, squeeze=False)
    for k, each in enumerate(shown):
        kind, _, role = each.what.partition(" of ")
        value = _depth_mm if kind == "contact" else _speed_mm_s
        for cycles, label, colour in (
            (replay.recorded.cycles, "run", _RUN),
            (replay.replayed.cycles, "replay", _REPLAY),
        ):
            t_s = np.array([1e-9 * (cycle.now_ns - replay.recorded.cycles[0].now_ns) for cycle in cycles])
            axes[0, k].plot(t_s, np.array([value(cycle, role) for cycle in cycles]), color=colour, lw=1.2, label=label)
        axes[0, k].set_title(f"{role}: depth (mm)" if kind == "contact" else f"{role}: speed sent (mm/s)")
        axes[1, k].plot(each.t_s, each.linear, color="#55a868", lw=1.0, label=f"apart, {each.units[0]}")
        axes[1, k].plot(each.t_s, each.angular, color="#8172b3", lw=1.0, label=f"apart, {each.units[1]}")
        axes[1, k].axhline(each.tolerance, color="black", lw=0.8, ls="--", label="tolerance")
        axes[1, k].set_xlabel("time (s)")
        for axis in axes[:, k]:
            axis.grid(alpha=0.3)
            axis.legend(fontsize=8)
    figure.suptitle(f"{replay.plan.cell.name}: recorded run, and the same frames and poses through today's code")
    figure.savefig(path, dpi=100)
    return path


def _depth_mm(cycle: RecordedCycle, role: str) -> float:
    depth = cycle.contacts.get(role, {}).get("z_mm")
    return float(depth) if isinstance(depth, int | float) else np.nan


def _speed_mm_s(cycle: RecordedCycle, role: str) -> float:
    twist: Array = numbers(cycle.commands.get(role, {}).get("twist"))
    return 1e3 * float(np.linalg.norm(twist[:3])) if twist.shape == (6,) else np.nan
