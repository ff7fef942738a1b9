"""``python -m benchmarks pushes``: whether a push that says done has brought its object to the target.

    python -m benchmarks --out bench pushes [--rigs 60] [--seeds 2 24 29] [--before FILE] [--map] [--tall]

Each rig is one of the experiments' prisms on one of their tables, pushed by one arm or by two, with truth sampled apart
from what is told: start to 20 mm and 20 deg off, mass to 50 % and friction to 30 % off, the centre of mass to 10 mm
beside the middle in every second rig, another tip than the network's, mount, latencies and arm lag. A false done is a
push that says done and whose object is farther from its target than the task's tolerance. The maps (``--map``, with
``--rigs 0`` alone) show the object's error over start offset and angle with one arm and with two, over friction and
mass, and over speed and target, with the shipped network on another tip than it knows, quasi-static. An interrupted
call goes on where it stopped. ``pushes_time.txt`` says in which states of the task the time passes, and with the
``pushes.json`` of an earlier call (``--before``) how the same rigs ended then. ``--tall`` (with ``--rigs 0``) pushes
the experiments' tall objects with both arms, half lighter and half heavier than told.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.analysis.run_folder import RunFolder
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
from touchcell.cell.experiments.runner import Scale
from touchcell.cell.experiments.tall_objects import SPEC as TALL
from touchcell.cell.experiments.tall_objects import WITH
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.simulation.objects import TABLES

_TOLERANCE_MM: Final = 5.0
_TIP: Final = "franka_tactip_1"
"""The tip fitted to a real sensor's images, which the shipped network does not know."""


@dataclass(frozen=True, slots=True)
class Map:
    """Errors of one push over two things that vary.

    Attributes:
        name: title of the picture.
        arms: that push.
        x, y: what varies, with units.
        xs, ys: their values.
        changes: returns keys of the cell for one of each, and the truth of the object.
    """

    name: str
    arms: Arms
    x: str
    y: str
    xs: tuple[float, ...]
    ys: tuple[float, ...]
    changes: Callable[[float, float], tuple[dict[str, Any], dict[str, Any]]]


def _start(offset_mm: float, turn_deg: float) -> tuple[dict[str, Any], dict[str, Any]]:
    return {}, {"pose_offset_mm_deg": [5, offset_mm, 0, 0, 0, turn_deg]}


def _load(friction: float, mass_percent: float) -> tuple[dict[str, Any], dict[str, Any]]:
    mass_g = 0.01 * mass_percent * PRISMS[0].mass_g
    return {}, {"friction": friction, "mass_g": mass_g, "pose_offset_mm_deg": [5, 8, 0, 0, 0, 8]}


def _course(speed_mm_s: float, aside_mm: float) -> tuple[dict[str, Any], dict[str, Any]]:
    keys = {"task.push_speed_mm_s": speed_mm_s, "task.target_mm": [300, aside_mm]}
    return keys, {"pose_offset_mm_deg": [5, 8, 0, 0, 0, 8]}


_STARTS: Final = (-20.0, -10.0, 0.0, 10.0, 20.0)
MAPS: Final = (
    Map("start, one arm", ONE_ARM, "mm aside", "deg turned", _STARTS, _STARTS, _start),
    Map("start, two arms", TWO_ARMS, "mm aside", "deg turned", _STARTS, _STARTS, _start),
    Map(
        "load, one arm",
        ONE_ARM,
        "friction (told: 0.3)",
        "mass, % of what is told",
        (0.15, 0.3, 0.45, 0.6, 0.75),
        (50.0, 75.0, 100.0, 125.0, 150.0),
        _load,
    ),
    Map(
        "course, one arm",
        ONE_ARM,
        "speed, mm/s",
        "target, mm aside",
        (20.0, 50.0, 80.0, 100.0, 120.0),
        (-120.0, -60.0, 0.0, 60.0, 120.0),
        _course,
    ),
)


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


def map_trial(of: Map, x: float, y: float) -> Trial:
    """Return the run at one point of a map."""
    pushed = PRISMS[0]
    keys, truth = of.changes(x, y)
    changes = of.arms.around(pushed, "mdf", PUSH_HEIGHT_MM) | of.arms.sampling(pushed, "mdf")
    changes |= {"scene.physics": "quasi_static", "scene.objects": _standing(pushed)} | keys
    changes["truth"] = {"objects": {OBJECT: truth}, "sensors": {sensor: {"tip": _TIP} for sensor in of.arms.sensors}}
    return Trial(f"map_{of.name.replace(', ', '_').replace(' ', '_')}_{x:g}_{y:g}", of.name, of.arms.cell, changes)


def verdict(finished: Finished) -> str:
    """Return how a push ended: done, false done, missed, tripped, or the outcome itself."""
    if finished.done:
        return "done" if finished.measures["object_error_mm"] <= _TOLERANCE_MM else "FALSE DONE"
    return "missed" if finished.reason.startswith("missed") else finished.outcome


def run(arguments: Sequence[str], out: Path) -> None:
    """Print a line for each rig and the table; write ``pushes.txt``, ``pushes.json`` and the map's picture."""
    parser = argparse.ArgumentParser(prog="pushes", description=__doc__.partition("\n")[0])
    parser.add_argument("--rigs", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="*", help="these rigs in place of the first")
    parser.add_argument("--before", type=Path, help="pushes.json of an earlier call, to compare with")
    parser.add_argument("--map", action="store_true", help="draw the maps, too")
    parser.add_argument("--maps", default="", metavar="WORD", help="only maps that have it in their names")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="of each axis of a map only each N-th value")
    parser.add_argument("--tall", action="store_true", help="push tall objects that weigh other than told")
    options = parser.parse_args(arguments)
    perform = Perform(measures, out / "pushes")
    rigs = [rig(seed) for seed in options.seeds or range(options.rigs)]
    before = {} if options.before is None else json.loads(options.before.read_text())
    if rigs:
        ended = _rigs(perform, rigs, out)
        lines = time_table(rigs, ended, {each["seed"]: each for each in before.get("rigs", ())})
        print("\n".join(lines))
        text = [f"{key}: {value}" for key, value in provenance().items()]
        if before:
            text.append(f"before: {before['provenance']['commit']}")
        (out / "pushes_time.txt").write_text("\n".join([*text, "", *lines]) + "\n")
    if options.map:
        _draw_maps(perform, out, [each for each in MAPS if options.maps in each.name], options.every)
    if options.tall:
        _tall(perform, out)


def measures(run: RunFolder) -> dict[str, float]:
    """Return the measures of the experiments, and how long the task was in each of its states."""
    found = push_measures(run)
    task = run.recording.series("/task")
    if task is None:
        return found
    for row, lasted_s in zip(task.rows, np.diff(task.t_s, append=task.t_s[-1:]), strict=True):
        name = f"state_{row.get('state')}_s"
        found[name] = found.get(name, 0.0) + float(lasted_s)
    return found


_TIMED: Final = ("prepare", "approach", "check", "settle", "sidestep", "run", "retract")


def time_table(
    rigs: Sequence[Rig], ended: Mapping[int, Finished], before: Mapping[int, Mapping[str, Any]]
) -> list[str]:
    """Return how long each rig was in each state, and its end beside an earlier one."""
    titles = "".join(f"{name:>10}" for name in _TIMED)
    lines = [f"{'seconds in each state':<48}{titles}{'touch to end':>14}{'object mm':>11}"]
    lines[0] += f"{'before: s':>11}{'mm':>7}" * bool(before)
    for each in rigs:
        found, verdict_now = ended[each.seed].measures, verdict(ended[each.seed])
        spent = "".join(f"{found.get(f'state_{name}_s', 0.0):>10.1f}" for name in _TIMED)
        lines.append(f"{each.seed:>3} {each.pushed.name:<13}{each.group:<31}{spent}{_ended(verdict_now, found)}")
        if then := before.get(each.seed):
            lines[-1] += f"{_ended(then['verdict'], then, seconds=11, mm=8)}"
    return lines


def _ended(verdict_then: str, found: Mapping[str, float], *, seconds: int = 14, mm: int = 11) -> str:
    took_s, off_mm = found.get("push_s", np.nan), found.get("object_error_mm", np.nan)
    return f"{took_s:>{seconds}.1f}{off_mm:>{mm}.2f}" if verdict_then == "done" else f"{verdict_then:>{seconds + mm}}"


def _rigs(perform: Perform, rigs: Sequence[Rig], out: Path) -> dict[int, Finished]:
    ended: dict[int, Finished] = {}
    for each in rigs:
        ended[each.seed] = _performed(perform, each.trial)
        print(f"{len(ended):>3}/{len(rigs)}  {each.pushed.name:<13}{_line(each.group, ended[each.seed])}", flush=True)
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
    return ended


WEIGHTS: Final = (0.5, 1.5)
"""True weight of tall objects, of what is told."""
_ARRIVED_MM: Final = 2.0


def tall_trials() -> list[tuple[str, float, Trial]]:
    """Return name, true weight over the told one, and push of each tall object with both arms and the network."""
    ends = f", {WITH}, learned"
    found = []
    for trial in TALL.trials(Scale(trials=1)):
        name = trial.row.removesuffix(ends)
        if name == trial.row:
            continue
        for weight in WEIGHTS:
            mass_g = weight * trial.changes["scene.objects"][OBJECT]["mass_g"]
            changes = {**trial.changes, "truth": {"objects": {OBJECT: {"mass_g": mass_g}}}}
            found.append((name, weight, Trial(f"{trial.name}_{weight:g}", trial.row, trial.cell, changes)))
    return found


def _tall(perform: Perform, out: Path) -> None:
    lines = [f"{'':<20}{'weight':>8}{'':>4}{'verdict':<12}{'object mm':>10}{'lean deg':>10}{'push s':>8}"]
    ended = []
    for name, weight, trial in tall_trials():
        ended.append(finished := _performed(perform, trial))
        found = finished.measures
        numbers = f"{found.get('object_error_mm', np.nan):>10.2f}{found.get('lean_max_deg', np.nan):>10.1f}"
        numbers += f"{found.get('push_s', np.nan):>8.1f}  {finished.reason[:80]}"
        lines.append(f"{name:<20}{weight:>8g}{'':>4}{verdict(finished):<12}{numbers}")
        print(lines[-1], flush=True)
    near = sum(each.done and each.measures["object_error_mm"] <= _ARRIVED_MM for each in ended)
    fallen = sum(each.measures.get("toppled", 0.0) > 0.0 for each in ended)
    lines += ["", f"of {len(ended)}: {near} arrive within {_ARRIVED_MM:g} mm, {fallen} topple"]
    print("\n".join(lines))
    text = [f"{key}: {value}" for key, value in provenance().items()]
    (out / "pushes_tall.txt").write_text("\n".join([*text, "", *lines]) + "\n")


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


def _draw_maps(perform: Perform, out: Path, maps: Sequence[Map], every: int) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.colors import LogNorm

    columns = min(len(maps), 2 if len(maps) > 3 else 3)
    rows = -(-len(maps) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5.5 * columns, 4.3 * rows), layout="constrained", squeeze=False)
    lines = [f"{key}: {value}" for key, value in provenance().items()] + [""]
    for ax, each in zip(axes.flat, maps, strict=False):
        xs, ys = each.xs[::every], each.ys[::every]
        errors = np.full((len(ys), len(xs)), np.nan)
        for (i, y), (j, x) in product(enumerate(ys), enumerate(xs)):
            finished = _performed(perform, map_trial(each, x, y))
            error_mm = finished.measures.get("object_error_mm", np.nan)
            lines.append(f"{each.name}: {each.x} {x:g}, {each.y} {y:g}: {_line('', finished).strip()}")
            print(lines[-1], flush=True)
            if finished.done:
                errors[i, j] = error_mm
            ax.text(
                j, i, f"{error_mm:.2f}" if finished.done else verdict(finished), ha="center", va="center", fontsize=8
            )
        image = ax.imshow(errors, origin="lower", cmap="YlGn_r", norm=LogNorm(0.1, 5.0), alpha=0.8, aspect="auto")
        ax.set(title=each.name, xlabel=each.x, ylabel=each.y)
        ax.set_xticks(range(len(xs)), [f"{x:g}" for x in xs])
        ax.set_yticks(range(len(ys)), [f"{y:g}" for y in ys])
    figure.colorbar(image, ax=axes, label="object from its target, mm (done)")
    figure.savefig(out / "pushes.png", dpi=110)
    plt.close(figure)
    (out / "pushes_maps.txt").write_text("\n".join(lines) + "\n")
