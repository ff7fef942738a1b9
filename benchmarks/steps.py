"""``python -m benchmarks steps``: step responses of whole cells, with network, filter, gate and interlocks in the loop.

    python -m benchmarks --out docs/benchmarks steps

The plate of ``object_track_sim.yaml`` stands, and jumps by 2 mm or 3 deg in one component within 50 ms. The error is
that of the sensor against one that would stick to the plate. Overshoot counts beyond the error that is left at the end,
and the contact has settled where the error stays within a tenth of the step of that. ``bench tuning`` has the same
loops without filter and interlocks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.experiments.object_tracking import CELL
from touchcell.cell.experiments.tracking_error import tracking
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.geometry.types import Array

STEPS: Final[Mapping[str, float]] = dict(zip(COMPONENTS, (2.0, 2.0, 2.0, 3.0, 3.0, 3.0), strict=True))
"""Jump of each component, mm and deg."""
AT_S: Final = 6.0
_WITHIN_S: Final = 0.05
_WATCHED_S: Final = 3.0
_END_S: Final = 0.5
_DEPTH_MM: Final = 4.0
"""As far from what interlocks allow as the jumps are."""
_SETTLED: Final = 0.1
TIPS: Final[Mapping[str, Mapping[str, Any]]] = {
    "matched": {},
    "a real sensor's tip": {"truth": {"sensors": {"sensor": {"tip": "franka_tactip_1"}}}},
}


def trial(component: str, tip: str) -> Trial:
    """Return the run of one step."""
    displacement = [STEPS[component] if name == component else 0.0 for name in COMPONENTS]
    motion = {"kind": "glide", "displacement_mm_deg": displacement, "start_s": AT_S, "duration_s": _WITHIN_S}
    changes = {
        "scene.surfaces.plate.motion": motion,
        "task.duration_s": AT_S + _WATCHED_S - 1.0,
        "seed": 1,
        **TIPS[tip],
    }
    changes["task.depth_mm"] = _DEPTH_MM
    return Trial(f"{component}_{tip.replace(' ', '_')}", tip, CELL, changes)


def response(t_s: Array, error: Array, size: float) -> dict[str, float]:
    """Return how an error (n,) of times since a step (n,) dies away.

    ``largest`` and ``left`` in units of the error; ``rise_s`` until it has come down to a tenth of the step,
    ``settled_s`` until it stays there, of what is left; ``overshoot_percent`` of the step.
    """
    after = t_s >= 0.0
    t_s, error = t_s[after], error[after]
    left = float(np.median(error[t_s > t_s[-1] - _END_S]))
    beyond = (error - left) * np.sign(error[np.argmax(np.abs(error - left))] - left)
    outside = np.abs(beyond) > _SETTLED * size
    largest_at = int(np.argmax(np.abs(beyond)))
    inside = np.flatnonzero(~outside[largest_at:])
    return {
        "largest": float(np.abs(error).max()),
        "left": left,
        "rise_s": float(t_s[largest_at + inside[0]]) if len(inside) else float("nan"),
        "settled_s": float(t_s[np.flatnonzero(outside)[-1]]) if outside.any() else 0.0,
        "overshoot_percent": 100.0 * max(0.0, float(-beyond[largest_at:].min())) / size,
    }


def measures(run: RunFolder) -> dict[str, float]:
    """Return the response of the component that the plate jumps in."""
    scene = run.plan.cell.scene
    assert scene is not None
    moved = scene["surfaces"]["plate"]["motion"]["displacement_mm_deg"]
    axis = int(np.argmax(np.abs(moved)))
    poses, _, error = tracking(run)
    known = np.isfinite(error[:, axis]) & (poses.t_s < AT_S + _WATCHED_S)
    before = known & (poses.t_s > AT_S - _END_S) & (poses.t_s < AT_S)
    return response(poses.t_s[known] - AT_S, error[known, axis] - float(np.mean(error[before, axis])), abs(moved[axis]))


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``steps.txt`` and ``steps.png``."""
    perform = Perform(measures, out / "steps")
    lines = [f"{'':<28}{'step':>6}{'largest':>9}{'rise s':>8}{'settled s':>11}{'overshoot %':>13}{'left':>8}  outcome"]
    ended: list[Finished] = []
    for tip in TIPS:
        for name, size in STEPS.items():
            ended.append(finished := perform.kept(trial(name, tip)) or perform(trial(name, tip)))
            found = finished.measures
            row = "".join(
                f"{found.get(key, np.nan):>{width}.{digits}f}"
                for key, width, digits in (
                    ("largest", 9, 2),
                    ("rise_s", 8, 2),
                    ("settled_s", 11, 2),
                    ("overshoot_percent", 13, 0),
                    ("left", 8, 2),
                )
            )
            lines.append(f"{name + ', ' + tip:<28}{size:>6g}{row}  {finished.outcome} {finished.reason[:60]}")
            print(lines[-1], flush=True)
    text = [f"{key}: {value}" for key, value in provenance().items()]
    (out / "steps.txt").write_text("\n".join([*text, "", *lines]) + "\n")
    _draw(ended, out / "steps.png")


def _draw(ended: Sequence[Finished], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(11, 5.5), layout="constrained", sharex=True)
    for ax, (name, size) in zip(axes.flat, STEPS.items(), strict=True):
        for each in ended:
            if each.trial.name.startswith(f"{name}_"):
                poses, _, error = tracking(each.folder)
                ax.plot(poses.t_s - AT_S, error[:, COMPONENTS.index(name)], label=each.trial.row, lw=1.2)
        ax.axhline(0.0, color="0.7", lw=0.8)
        ax.set(title=f"{name}: {size:g} {'mm' if name in COMPONENTS[:3] else 'deg'}", xlim=(-0.3, 2.0))
    axes[0, 0].legend(fontsize=8)
    for ax in axes[1]:
        ax.set_xlabel("s after the jump")
    figure.savefig(path, dpi=110)
    plt.close(figure)
