"""Search for the settings that make a measure smallest, by Optuna, among runs that end as done."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchcell.cell.experiments.executors import Workers
from touchcell.cell.experiments.run_trials import perform_all
from touchcell.cell.experiments.trials import Finished, Perform, Trial
from touchcell.cell.sweeps.factors import Distribution
from touchcell.cell.sweeps.sweep import Sweep
from touchcell.errors import ConfigError

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Searched:
    """What a search found.

    Attributes:
        best: the trial with the smallest measure among those that ended as done; None if none did.
        finished: all trials, in order.
    """

    best: Finished | None
    finished: tuple[Finished, ...]


def search(
    sweep: Sweep,
    space: Mapping[str, Distribution],
    measure: str,
    trials: int,
    folder: Path,
    *,
    workers: Workers | None = None,
    executor: str = "local",
    live: bool = False,
    seed: int = 0,
) -> Searched:
    """Minimise the magnitude of ``measure`` over ``space``.

    A trial that trips or fails is infeasible, whatever its measure. The search is deterministic and its trials are
    kept, so the same call resumes where it was interrupted.

    Args:
        sweep: the cell, with settings in place of the file's own; its factors are not used.
        space: uniform, loguniform or choice, by dotted key.
        measure: name of what is minimised.
        trials: how many in all.
        folder: for ``trials/``.
        workers: how many at a time, and their limits.
        executor: name of what runs the trials.
        live: show progress.
        seed: of the search.

    Raises:
        ConfigError: a key's distribution cannot be searched, or no trial has the measure.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    perform = Perform(sweep.measure, folder / "trials")
    batch = max(1, (workers or Workers()).jobs)
    finished: list[Finished] = []
    while len(finished) < trials:
        asked = [study.ask() for _ in range(min(batch, trials - len(finished)))]
        made = [
            Trial(
                f"{len(finished) + offset:04}",
                "search",
                str(sweep.cell.absolute()),
                {**(sweep.settings or {}), **{key: _suggest(each, key, draw) for key, draw in space.items()}},
            )
            for offset, each in enumerate(asked)
        ]
        ended = perform_all(perform, made, workers=workers, executor=executor, live=live, title=f"search {measure}")
        for each, result in zip(asked, ended, strict=True):
            value = result.measures.get(measure)
            each.set_constraint("ends as done", 0.0 if result.done else 1.0)
            if value is None:
                study.tell(each, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(each, abs(value))
        finished += ended
    if all(measure not in each.measures for each in finished):
        known = sorted({name for each in finished for name in each.measures})
        raise ConfigError("no trial has such a measure", key="--search", value=measure, hint=", ".join(known[:20]))
    feasible = [each for each in finished if each.done and measure in each.measures]
    best = min(feasible, key=lambda each: abs(each.measures[measure]), default=None)
    return Searched(best, tuple(finished))


def _suggest(trial: Any, key: str, draw: Distribution) -> Any:
    if draw.kind == "choice":
        return trial.suggest_categorical(key, list(draw.parameters))
    if draw.kind == "normal":
        raise ConfigError("a normal distribution has no bounds to search in", key=key, hint="uniform(LOW, HIGH)")
    low, high = draw.parameters
    return trial.suggest_float(key, low, high, log=draw.kind == "loguniform")
