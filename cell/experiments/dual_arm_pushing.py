"""Dual-arm pushing (paper 5.7.1): the same prisms, surfaces and target, with a follower that steadies the far side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cell.experiment import ExperimentSpec, Scale
from cell.experiments.pushing import (
    COLUMNS,
    ERROR_NOTE,
    ESTIMATORS,
    PRISMS,
    PUSH_HEIGHT_MM,
    SURFACES,
    Pushed,
    estimator_changes,
    follower_changes,
    leader_changes,
    object_changes,
    push_measures,
    starts,
)
from cell.run_folder import RunFolder
from cell.trials import Finished, Trial

LEADER_SENSOR, FOLLOWER_SENSOR = "leader_sensor", "follower_sensor"
CELL = "dual_push_sim.yaml"


def trials(scale: Scale) -> list[Trial]:
    """Every prism on every surface with both estimators; each repetition starts a little elsewhere."""
    found = []
    for estimator in ESTIMATORS:
        for surface in SURFACES:
            for pushed in PRISMS[:1] if scale.quick and estimator != "learned" else PRISMS:
                row = f"{pushed.name}, {surface}, {estimator}"
                changes = two_arms(pushed, surface, PUSH_HEIGHT_MM)
                changes |= estimator_changes(estimator, (LEADER_SENSOR, FOLLOWER_SENSOR))
                for seed, pose in starts(scale.repetitions(5)):
                    whole = changes | object_changes(pushed, pose) | {"seed": seed}
                    found.append(Trial(f"{row.replace(', ', '_').replace(' ', '_')}_{seed}", row, CELL, whole))
    return found


def two_arms(pushed: Pushed, surface: str, height_mm: float) -> dict[str, Any]:
    """Keys of a cell in which the arms stand on both sides of an object."""
    return leader_changes(pushed, surface, "leader", height_mm) | follower_changes(pushed, height_mm)


def measure(run: RunFolder) -> Mapping[str, float]:
    """See ``pushing.push_measures``; of the leader."""
    return push_measures(run, LEADER_SENSOR)


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """The paper's figure 19, and every trial's error."""
    from cell.experiments.pushing_plots import plot_errors, plot_pushes

    return [
        plot_pushes([each for each in finished if "learned_1" in each.trial.name], folder / "pushes.png"),
        plot_errors(finished, folder / "errors.png", aim_mm=2.0),
    ]


SPEC = ExperimentSpec(
    name="dual_arm_pushing",
    summary="two arms push four prisms over two surfaces 300 mm to a target",
    trials=trials,
    measure=measure,
    columns=COLUMNS,
    draw=draw,
    paper={f"{p.name}, {surface}, {e}": "< 5 mm" for p in PRISMS for surface in SURFACES for e in ESTIMATORS},
    notes=(ERROR_NOTE,),
)
