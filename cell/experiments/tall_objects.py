"""Tall objects (paper 5.7.2): four prisms of double height and five bottles, pushed high up, with and without follower.

The paper tells masses and neither sizes nor how high it pushes. Prisms are the short ones doubled; bottles are turned
bodies of about the size of those that the paper names. Each is pushed a tenth higher than where one sticky tip begins
to topple it, or just below the top of its straight part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cell.experiment import ExperimentSpec, Scale
from cell.experiments.dual_arm_pushing import LEADER_SENSOR, two_arms
from cell.experiments.pushing import (
    ERROR_NOTE,
    PRISMS,
    Pushed,
    leader_changes,
    object_changes,
    push_measures,
    starts,
)
from cell.run_folder import RunFolder
from cell.trial_table import Column
from cell.trials import Finished, Trial

WITH, WITHOUT = "with follower", "alone"
_CELLS = {WITH: "dual_push_tall_sim.yaml", WITHOUT: "single_push_sim.yaml"}
_BELOW_TOP_MM = 15.0
_MDF = 0.3
_TIP_FRICTION = 0.9
# Feet of simulated objects, as a share of the way from the middle to the side (docs/simulation.md).
_FEET = {"box": 0.766, "hexagon": 0.766, "cylinder": 2.0 / 3.0, "bottle": 2.0 / 3.0}
_TALL_G = (566.0, 436.0, 324.0, 373.0)


def _bottle(name: str, mass_g: float, *sections_mm: tuple[float, float]) -> Pushed:
    shape = {"kind": "bottle", "sections_mm": [list(each) for each in sections_mm]}
    return Pushed(name, shape, mass_g, 0.5 * sections_mm[0][1])


OBJECTS = (
    *(prism.taller(mass_g) for prism, mass_g in zip(PRISMS, _TALL_G, strict=True)),
    _bottle("mustard bottle", 237, (150, 76), (40, 30)),
    _bottle("cream cleaner", 161, (160, 80), (50, 35)),
    _bottle("window spray", 339, (160, 84), (100, 35)),
    _bottle("glass bottle", 641, (180, 76), (110, 30)),
    _bottle("coffee tin", 214, (139, 102)),
)


def trials(scale: Scale) -> list[Trial]:
    """Every object with both arms, and with the leader alone from the same starts."""
    found = []
    for arms, cell in _CELLS.items():
        for pushed in OBJECTS[::4] if scale.quick else OBJECTS:
            height_mm = round(min(1.1 * topples_at_mm(pushed), _straight_mm(pushed) - _BELOW_TOP_MM), 1)
            if arms == WITH:
                changes = two_arms(pushed, "mdf", height_mm)
                changes |= _boxes_up_to(height_mm, "leader_box", "follower_box")
            else:
                changes = leader_changes(pushed, "mdf", "arm", height_mm) | _boxes_up_to(height_mm, "workspace")
            row = f"{pushed.name}, {arms}"
            for seed, pose in starts(scale.repetitions(5)):
                whole = changes | object_changes(pushed, pose) | {"seed": seed}
                found.append(Trial(f"{row.replace(', ', '_').replace(' ', '_')}_{seed}", row, cell, whole))
    return found


def measure(run: RunFolder) -> Mapping[str, float]:
    """See ``pushing.push_measures``."""
    sensors = run.plan.sensor_roles
    return push_measures(run, LEADER_SENSOR if LEADER_SENSOR in sensors else next(iter(sensors)))


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """The paper's figure 20, the same from the side without follower, and how far each leant."""
    from cell.experiments.pushing_plots import plot_leans, plot_pushes
    from cell.outlines import SIDE

    first = [each for each in finished if each.trial.name.endswith("_1")]
    return [
        plot_pushes([each for each in first if WITH in each.trial.row], folder / "with_follower.png"),
        plot_pushes([each for each in first if WITHOUT in each.trial.row], folder / "alone_side.png", view=SIDE),
        plot_leans(first, folder / "leans.png"),
    ]


def topples_at_mm(pushed: Pushed) -> float:
    """Height of a push by one sticky tip above which an object topples over its leading feet.

    Balance of moments about the feet, at r from the middle, with the pushed side at a: the push F = mu (m g + mu_tip F)
    against m g r and the tip's grip mu_tip F (r + a), which holds the pushed side down.
    """
    r_mm = _FEET[str(pushed.shape["kind"])] * pushed.reach_mm
    grip = 1.0 - _MDF * _TIP_FRICTION
    return r_mm * grip / _MDF + _TIP_FRICTION * (r_mm + pushed.reach_mm)


def _straight_mm(pushed: Pushed) -> float:
    """Height of the part that is pushed."""
    if "sections_mm" in pushed.shape:
        return float(pushed.shape["sections_mm"][0][0])
    return float(pushed.shape["size_mm"][2] if "size_mm" in pushed.shape else pushed.shape["height_mm"])


def _boxes_up_to(height_mm: float, *interlocks: str) -> dict[str, Any]:
    bottoms = {"follower_box": [450, -250]}
    tops = {"follower_box": [990, 250]}
    found: dict[str, Any] = {}
    for name in interlocks:
        found[f"interlocks.{name}.min_mm"] = [*bottoms.get(name, [-150, -250]), 10]
        found[f"interlocks.{name}.max_mm"] = [*tops.get(name, [400, 250]), height_mm + 60]
    return found


SPEC = ExperimentSpec(
    name="tall_objects",
    summary="four tall prisms and five bottles pushed high up, with the follower and without",
    trials=trials,
    measure=measure,
    columns=(
        Column("toppled", "toppled", "count"),
        Column("lean_max_deg", "lean deg", "worst", 1),
        Column("error_mm", "error mm", digits=2),
        Column("error_mm", "worst", "worst"),
    ),
    draw=draw,
    paper={f"{pushed.name}, {arms}": "stands" if arms == WITH else "topples" for arms in _CELLS for pushed in OBJECTS},
    notes=(ERROR_NOTE, "aims: none of nine topples with the follower, at least seven without"),
)
