"""Tall objects (paper 5.7.2): four tall prisms and five bottles, pushed high up, with and without follower.

The paper states masses but neither sizes nor push heights. Prisms are those of the other experiments, but 200 mm
high; bottles are solids of revolution about as thick as those that the paper names. Each is pushed at 80 % of its
height, or just below the top of its straight part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.experiments.pushing import (
    ERROR_NOTE,
    ESTIMATORS,
    ONE_ARM,
    PRISMS,
    TWO_ARMS,
    Pushed,
    push_measures,
    row_trials,
)
from touchcell.cell.experiments.runner import ExperimentSpec, Scale
from touchcell.cell.experiments.table import Column
from touchcell.cell.experiments.trials import Finished, Trial
from touchcell.simulation.quasi_static import GRAVITY_M_S2
from touchcell.tasks.push_standing import LEAN_DEG

WITH, WITHOUT = "with follower", "alone"
_ARMS = {WITH: replace(TWO_ARMS, cell="dual_push_tall_sim.yaml"), WITHOUT: ONE_ARM}
_PRISM_MM = 200.0
_PUSHED_AT = 0.8
_BELOW_TOP_MM = 15.0
_FOLLOWER_MM = 3.0
# Shear stiffness of the cells' tips; the paper's shear, and the largest: more slips at _FOLLOWER_MM, and at the 2 mm
# that friction on the table leaves the leader before it pushes. More than is needed makes objects heavier to push.
_SHEAR_N_MM = 0.4
_SHEAR_MIN_MM, _SHEAR_MAX_MM = 0.5, 2.5
_SAFETY = 1.1
_ROUND = ("cylinder", "bottle")
# The cell's follower yields laterally but slowly, for objects with flat sides: on these its contact would drift off the
# line of the push, and the squeeze then turns a light slim one as much as friction on the table resists. The squeeze
# on a round one always points at its axis. There the leader steers by moving around it; for one squeezed harder than
# the table holds it, a follower that only complies reacts too late, and wide ones weave by centimetres.
_FOLLOWER_OF_ROUND = {
    "task.follower.kp_per_s": [4, 10, 10, 10, 0, 0],
    "task.follower.ki_per_s2": [0, 25, 25, 25, 0, 0],
}
_MDF = 0.3
_STIFFNESS_N_MM = 0.6
_TALL_G = (566.0, 436.0, 324.0, 373.0)


def _bottle(name: str, mass_g: float, *sections_mm: tuple[float, float]) -> Pushed:
    shape = {"kind": "bottle", "sections_mm": [list(each) for each in sections_mm]}
    return Pushed(name, shape, mass_g, 0.5 * sections_mm[0][1])


OBJECTS = (
    *(prism.taller(_PRISM_MM, mass_g) for prism, mass_g in zip(PRISMS, _TALL_G, strict=True)),
    _bottle("mustard bottle", 237, (145, 58), (45, 30)),
    _bottle("cream cleaner", 161, (170, 65), (80, 30)),
    _bottle("window spray", 339, (180, 80), (90, 35)),
    _bottle("glass bottle", 641, (180, 76), (110, 30)),
    _bottle("coffee tin", 214, (139, 102)),
)


def trials(scale: Scale) -> list[Trial]:
    """Return trials of every object with both arms, and with the leader alone from the same starts; both estimators."""
    return [
        trial
        for estimator in ESTIMATORS
        for arms in _ARMS
        for pushed in (OBJECTS[::4] if scale.quick else OBJECTS)
        for trial in row_trials(
            f"{pushed.name}, {arms}, {estimator}",
            _ARMS[arms].cell,
            pushed,
            _cell_changes(pushed, arms) | _ARMS[arms].estimating(estimator),
            scale.repetitions(5),
        )
    ]


def _cell_changes(pushed: Pushed, arms: str) -> dict[str, Any]:
    height_mm = pushed_at_mm(pushed)
    # Both in the same world: the shipped cells differ in this.
    # Slowly: fast pushes topple.
    same: dict[str, Any] = {"scene.step_ms": 5, "task.push_speed_mm_s": 20.0}
    is_round = pushed.shape["kind"] in _ROUND
    if arms == WITHOUT or is_round:
        # By the paper's controller: a round object rolls off the line that is predicted for it.
        same["task.steering"] = "bearing"
    same |= _ARMS[arms].around(pushed, "mdf", height_mm)
    if arms == WITHOUT:
        return same | _boxes_up_to(height_mm, "workspace")
    held_mm = held_with_mm(pushed)
    same["task.reference_mm_deg"] = [held_mm, 0, 0, 0, 0, 0]
    same["task.follower.active"] = False
    same["task.follower.reference_mm_deg"] = [-held_mm, 0, _FOLLOWER_MM, 0, 0, 0]
    if is_round:
        same |= _FOLLOWER_OF_ROUND
        held_n = _MDF * 1e-3 * pushed.mass_g * GRAVITY_M_S2
        same["task.follower.active"] = held_n < _STIFFNESS_N_MM * _FOLLOWER_MM
    return same | _boxes_up_to(height_mm, "leader_box", "follower_box")


def measure(run: RunFolder) -> Mapping[str, float]:
    """Return ``pushing.push_measures`` plus ``lost``: leant so far that a push is given up, fallen or not."""
    found = push_measures(run)
    return found | {"lost": float(found["lean_max_deg"] > LEAN_DEG)}


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """Plot the paper's figure 20, the same in side view without follower, and each object's lean; learned estimator."""
    from touchcell.cell.experiments.pushing_plots import plot_leans, plot_pushes
    from touchcell.simulation.outlines import SIDE

    arms = {
        arms: [each for each in finished if each.trial.name.endswith(f"{arms}_learned_1".replace(" ", "_"))]
        for arms in _ARMS
    }
    return [
        plot_pushes(arms[WITH], folder / "with_follower.png"),
        plot_pushes(arms[WITHOUT], folder / "alone_side.png", view=SIDE),
        plot_leans(arms, folder / "leans.png"),
    ]


def pushed_at_mm(pushed: Pushed) -> float:
    """Return the height of the push: 80 % of the object's, or just below the top of its straight part."""
    if "sections_mm" in pushed.shape:
        heights_mm = [float(height_mm) for height_mm, _ in pushed.shape["sections_mm"]]
        return min(_PUSHED_AT * sum(heights_mm), heights_mm[0] - _BELOW_TOP_MM)
    return _PUSHED_AT * float(pushed.shape["size_mm"][2] if "size_mm" in pushed.shape else pushed.shape["height_mm"])


def held_with_mm(pushed: Pushed) -> float:
    """Return the shear with which the leader presses down at its contact, and as much lifts the follower at its own.

    Both create a moment against toppling. Too little and the object topples over its leading edge while it is pushed;
    too much and it topples backwards at rest.
    """
    weight_n = 1e-3 * pushed.mass_g * GRAVITY_M_S2
    topples_n_mm = weight_n * (_MDF * pushed_at_mm(pushed) - pushed.reach_mm)
    shear_mm = _SAFETY * topples_n_mm / (2.0 * _SHEAR_N_MM * pushed.reach_mm)
    return round(min(max(shear_mm, _SHEAR_MIN_MM), _SHEAR_MAX_MM), 2)


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
        Column("lost", f"lean > {LEAN_DEG:g} deg", "count"),
        Column("lean_max_deg", "lean deg", "worst", 1),
        Column("error_mm", "error mm", digits=2),
        Column("error_mm", "worst", "worst"),
    ),
    draw=draw,
    paper={
        f"{pushed.name}, {arms}, {estimator}": "stands" if arms == WITH else "topples"
        for estimator in ESTIMATORS
        for arms in _ARMS
        for pushed in OBJECTS
    },
    notes=(
        ERROR_NOTE,
        f"goals: none of nine leans by {LEAN_DEG:g} deg with the follower, where a push is given up, "
        "at least seven without",
    ),
)
