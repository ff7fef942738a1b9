"""Single-arm pushing (paper 5.6): four prisms over two surfaces to a target, five trials each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cell.experiment import ExperimentSpec, Scale
from cell.experiments.pushing import (
    ESTIMATORS,
    PRISMS,
    SURFACES,
    estimator_changes,
    leader_changes,
    object_changes,
    push_measures,
    starts,
)
from cell.run_folder import RunFolder
from cell.trial_table import Column
from cell.trials import Finished, Trial

SENSOR = "sensor"
CELL = "single_push_sim.yaml"
_HEIGHT_MM = 30.0


def trials(scale: Scale) -> list[Trial]:
    """Every prism on every surface with both estimators; each repetition starts a little elsewhere."""
    found = []
    for estimator in ESTIMATORS:
        for surface in SURFACES:
            for pushed in PRISMS:
                row = f"{pushed.name}, {surface}, {estimator}"
                for seed, pose in starts(scale.repetitions(5)):
                    changes = leader_changes(pushed, surface, "arm", _HEIGHT_MM) | object_changes(pushed, pose)
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


def paper_figures(round_mm: str, other_mm: str) -> dict[str, str]:
    """What the paper reports, by row."""
    return {
        f"{pushed.name}, {surface}, {estimator}": round_mm if pushed.name == "circular" else other_mm
        for estimator in ESTIMATORS
        for surface in SURFACES
        for pushed in PRISMS
    }


COLUMNS = (
    Column("error_mm", "error mm", below=2.0),
    Column("error_mm", "worst", "worst"),
    Column("middle_mm", "middle to target mm"),
    Column("lean_max_deg", "lean deg", "worst"),
)

SPEC = ExperimentSpec(
    name="single_arm_pushing",
    summary="one arm pushes four prisms over two surfaces 300 mm to a target",
    trials=trials,
    measure=measure,
    columns=COLUMNS,
    draw=draw,
    paper=paper_figures("< 10 mm", "< 5 mm"),
    notes=("error: from the target to the true contact normal when the push ends, from above",),
)
