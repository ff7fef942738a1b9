"""Single-arm pushing (paper 5.6): four prisms over two surfaces to a target, five trials each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cell.experiment import ExperimentSpec, Scale
from cell.experiments.pushing import (
    COLUMNS,
    ERROR_NOTE,
    ESTIMATORS,
    PRISMS,
    PUSH_HEIGHT_MM,
    SURFACES,
    estimator_changes,
    leader_changes,
    object_changes,
    push_measures,
    starts,
)
from cell.run_folder import RunFolder
from cell.trials import Finished, Trial

SENSOR = "sensor"
CELL = "single_push_sim.yaml"


def trials(scale: Scale) -> list[Trial]:
    """Every prism on every surface with both estimators; each repetition starts a little elsewhere."""
    found = []
    for estimator in ESTIMATORS:
        for surface in SURFACES:
            for pushed in PRISMS[:1] if scale.quick and estimator != "learned" else PRISMS:
                row = f"{pushed.name}, {surface}, {estimator}"
                for seed, pose in starts(scale.repetitions(5)):
                    changes = leader_changes(pushed, surface, "arm", PUSH_HEIGHT_MM) | object_changes(pushed, pose)
                    changes |= estimator_changes(estimator, [SENSOR]) | {"seed": seed}
                    found.append(Trial(f"{row.replace(', ', '_').replace(' ', '_')}_{seed}", row, CELL, changes))
    return found


def measure(run: RunFolder) -> Mapping[str, float]:
    """See ``pushing.push_measures``."""
    return push_measures(run, SENSOR)


def draw(finished: Sequence[Finished], folder: Path) -> list[Path]:
    """The paper's figure 18, and every trial's error."""
    from cell.experiments.pushing_plots import plot_errors, plot_pushes

    return [
        plot_pushes([each for each in finished if "learned_1" in each.trial.name], folder / "pushes.png"),
        plot_errors(finished, folder / "errors.png", aim_mm=2.0),
    ]


SPEC = ExperimentSpec(
    name="single_arm_pushing",
    summary="one arm pushes four prisms over two surfaces 300 mm to a target",
    trials=trials,
    measure=measure,
    columns=COLUMNS,
    draw=draw,
    paper={
        f"{pushed.name}, {surface}, {estimator}": "< 10 mm" if pushed.name == "circular" else "< 5 mm"
        for pushed in PRISMS
        for surface in SURFACES
        for estimator in ESTIMATORS
    },
    notes=(ERROR_NOTE,),
)
