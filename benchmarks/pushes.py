"""``python -m benchmarks pushes``: whether a push that says done has brought its object to the target.

    python -m benchmarks --out bench pushes [--rigs 60] [--map]

Each rig is one of the experiments' prisms on one of their tables, pushed by one arm or by two, with truth sampled apart
from what is told: start to 20 mm and 20 deg off, mass to 50 % and friction to 30 % off, the centre of mass to 10 mm
beside the middle in every second rig, another tip than the network's, mount, latencies and arm lag. A false done is a
push that says done and whose object is farther from its target than the task's tolerance. The map shows the object's
error over start offset and angle, on the true contact. An interrupted call goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.experiments.push_measures import OBJECT
from touchcell.cell.experiments.pushing import (
    ONE_ARM,
    PRISMS,
    PUSH_HEIGHT_MM,
    SURFACES,
    TWO_ARMS,
    Arms,
    Pushed,
    push_measures,
)
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.simulation.objects import TABLES

_TOLERANCE_MM: Final = 5.0
_OFFSETS_MM: Final = (-20, -10, 0, 10, 20)
_TURNS_DEG: Final = (-20, -10, 0, 10, 20)


@dataclass(frozen=True, slots=True)
class Rig:
    """A sampled push.

    Attributes:
        seed: which one.
        arms: that push.
        pushed: the object.
        aside: whether its centre of mass is beside its middle.
        trial: the run.
    """

    seed: int
    arms: Arms
    pushed: Pushed
    aside: bool
    trial: Trial

    @property
    def group(self) -> str:
        """Line of the table."""
        return f"{self.arms.name}{', centre of mass aside' if self.aside else ''}"


def rig(seed: int) -> Rig:
    """Return the rig of a seed."""
    arms, aside = (ONE_ARM, TWO_ARMS)[seed % 2], seed % 4 >= 2
    pushed, surface = PRISMS[seed // 4 % len(PRISMS)], SURFACES[seed // 16 % len(SURFACES)]
    changes = arms.around(pushed, surface, PUSH_HEIGHT_MM) | arms.sampling(pushed, surface)
    friction = TABLES[surface]
    told: dict[str, Any] = changes["truth"]["objects"][OBJECT]
    told |= {
        "mass_g": {"uniform": [0.5 * pushed.mass_g, 1.5 * pushed.mass_g]},
        "friction": {"uniform": [0.7 * friction, 1.3 * friction]},
        "center_of_mass_mm": [{"uniform": [-10, 10]}] * 2 if aside else [0, 0],
    }
    changes |= {"scene.objects": _standing(pushed), "seed": seed}
    return Rig(seed, arms, pushed, aside, Trial(f"rig_{seed}", arms.name, arms.cell, changes))


def _standing(pushed: Pushed) -> dict[str, Any]:
    section = {"shape": dict(pushed.shape), "mass_g": pushed.mass_g, "pose_mm_deg": [0, 0, 0, 0, 0, 0]}
    return {OBJECT: section}


def map_trial(arms: Arms, offset_mm: float, turn_deg: float) -> Trial:
    """Return the run at one point of the map."""
    pushed = PRISMS[0]
    changes = arms.around(pushed, "mdf", PUSH_HEIGHT_MM) | arms.sampling(pushed, "mdf")
    changes |= arms.estimating("true contact") | {"scene.physics": "quasi_static", "scene.objects": _standing(pushed)}
    changes["truth"] = {"objects": {OBJECT: {"pose_offset_mm_deg": [5, offset_mm, 0, 0, 0, turn_deg]}}}
    return Trial(f"map{len(arms.sensors)}_{offset_mm:g}_{turn_deg:g}", arms.name, arms.cell, changes)


def verdict(finished: Finished) -> str:
    """Return how a push ended: done, false done, missed, tripped, or the outcome itself."""
    if finished.done:
        return "done" if finished.measures["object_error_mm"] <= _TOLERANCE_MM else "FALSE DONE"
    return "missed" if finished.reason.startswith("missed") else finished.outcome


def run(arguments: Sequence[str], out: Path) -> None:
    """Print a line for each rig and the table; write ``pushes.txt``, ``pushes.json`` and the map's picture."""
    parser = argparse.ArgumentParser(prog="pushes", description=__doc__.partition("\n")[0])
    parser.add_argument("--rigs", type=int, default=60)
    parser.add_argument("--map", action="store_true", help="draw the map, too")
    options = parser.parse_args(arguments)
    perform = Perform(push_measures, out / "pushes")
    rigs = [rig(seed) for seed in range(options.rigs)]
    ended: dict[int, Finished] = {}
    for each in rigs:
        ended[each.seed] = _performed(perform, each.trial)
        print(
            f"{each.seed + 1:>3}/{len(rigs)}  {each.pushed.name:<13}{_line(each.group, ended[each.seed])}", flush=True
        )
    lines = table(rigs, ended)
    print("\n".join(lines))
    text = [f"{key}: {value}" for key, value in provenance().items()]
    text += ["", *lines, "", "each rig:"]
    text += [f"{each.seed:>3}  {each.pushed.name:<13}{_line(each.group, ended[each.seed])}" for each in rigs]
    (out / "pushes.txt").write_text("\n".join(text) + "\n")
    rows = [
        {
            "seed": each.seed,
            "group": each.group,
            "verdict": verdict(ended[each.seed]),
            "reason": ended[each.seed].reason,
        }
        | dict(ended[each.seed].measures)
        for each in rigs
    ]
    (out / "pushes.json").write_text(json.dumps({"provenance": provenance(), "rigs": rows}, indent=1) + "\n")
    if options.map:
        _draw_maps(perform, out)


def _performed(perform: Perform, trial: Trial) -> Finished:
    return perform.kept(trial) or perform(trial)


def _line(group: str, finished: Finished) -> str:
    measures = finished.measures
    error_mm, took_s = measures.get("object_error_mm", float("nan")), measures.get("push_s", float("nan"))
    return f"{group:<34}{verdict(finished):<11}{error_mm:>8.2f} mm {took_s:>6.1f} s  {finished.reason[:100]}"


def table(rigs: Sequence[Rig], ended: Mapping[int, Finished]) -> list[str]:
    """Return how the rigs of each group ended, with the objects' own errors in each class."""
    lines = [f"{'':<34}{'verdict':<11}{'rigs':>5}  object's distance from its target, mm: median, worst"]
    for group in sorted({each.group for each in rigs}):
        members = [ended[each.seed] for each in rigs if each.group == group]
        for name in sorted({verdict(each) for each in members}):
            errors = [each.measures.get("object_error_mm", np.nan) for each in members if verdict(each) == name]
            worst = f"{np.nanmedian(errors):8.2f} {np.nanmax(errors):8.2f}" if np.isfinite(errors).any() else ""
            lines.append(f"{group:<34}{name:<11}{len(errors):>5}  {worst}")
    false = sum(verdict(each) == "FALSE DONE" for each in ended.values())
    lines.append(f"false done (more than {_TOLERANCE_MM:g} mm off): {false} of {len(ended)}")
    return lines


def _draw_maps(perform: Perform, out: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.colors import LogNorm

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", sharey=True)
    for ax, arms in zip(axes, (ONE_ARM, TWO_ARMS), strict=True):
        errors = np.full((len(_TURNS_DEG), len(_OFFSETS_MM)), np.nan)
        for (i, turn), (j, offset) in product(enumerate(_TURNS_DEG), enumerate(_OFFSETS_MM)):
            finished = _performed(perform, map_trial(arms, offset, turn))
            error_mm = finished.measures.get("object_error_mm", np.nan)
            print(f"map, {arms.name}, {offset} mm, {turn} deg: {verdict(finished)} {error_mm:.2f} mm", flush=True)
            if finished.done:
                errors[i, j] = error_mm
            text = f"{error_mm:.2f}" if finished.done else verdict(finished)
            ax.text(offset, turn, text, ha="center", va="center", fontsize=8)
        step = _OFFSETS_MM[1] - _OFFSETS_MM[0]
        low, high = _OFFSETS_MM[0] - step / 2, _OFFSETS_MM[-1] + step / 2
        image = ax.imshow(
            errors, origin="lower", extent=(low, high, low, high), cmap="YlGn_r", norm=LogNorm(0.1, 5.0), alpha=0.8
        )
        ax.set(title=arms.name, xlabel="start, mm aside", xticks=_OFFSETS_MM, yticks=_TURNS_DEG)
    axes[0].set_ylabel("start, deg turned")
    figure.colorbar(image, ax=axes, label="object from its target, mm (done)")
    figure.savefig(out / "pushes.png", dpi=110)
    plt.close(figure)
