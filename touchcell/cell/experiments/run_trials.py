"""Run the missing ones of many trials on an executor."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from touchcell.cell.experiments.elsewhere import Parcel, RunElsewhere, parcel, unpack
from touchcell.cell.experiments.executors import EXECUTORS, Lost, Workers
from touchcell.cell.experiments.remote_work import send_by_value
from touchcell.cell.experiments.trials import INVALID, LOST, Finished, Perform, Trial
from touchcell.errors import ConfigError
from touchcell.progress import shown_progress

_logger: Final = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TrialsResult:
    """What many trials showed.

    Attributes:
        text: the summary, for people.
        finished: all trials, in order.
    """

    text: str
    finished: tuple[Finished, ...]

    @property
    def complete(self) -> bool:
        """True if every trial came to an outcome of its cell."""
        return not any(each.broken for each in self.finished)


def perform_all(
    perform: Perform,
    trials: Sequence[Trial],
    *,
    workers: Workers | None = None,
    executor: str = "local",
    live: bool = False,
    title: str = "",
) -> list[Finished]:
    """Run the missing ones of ``trials``; return all of them in order.

    Args:
        perform: runs one.
        trials: all trials.
        workers: how many at a time, and their limits; one without limits runs in this process.
        executor: name of what runs them, with ``:ADDRESS`` where it takes one.
        live: show progress.
        title: on it.

    Raises:
        ConfigError: there is no such executor.
        WorkerDiffers: a worker elsewhere has other code.
        KeyboardInterrupt: running trials are ended; finished ones are kept.
    """
    name, _, address = executor.partition(":")
    spec = EXECUTORS.load(name)
    workers = replace(workers or Workers(), address=address)
    found: dict[str, Finished] = {}
    missing: list[Trial] = []
    parcels: list[Parcel] = []
    for trial in trials:
        try:
            kept = perform.kept(trial)
            if kept is None and not spec.shares_files:
                parcels.append(parcel(trial))
        except ConfigError as error:
            kept = perform.record_broken(trial, INVALID, str(error))
        if kept is None:
            missing.append(trial)
        else:
            found[trial.name] = kept
    with shown_progress(live=live) as show:
        if spec.shares_files:
            results = spec.run(perform, missing, workers)
        else:
            send_by_value(perform.measure)
            results = spec.run(RunElsewhere(perform.measure, perform.code), parcels, workers)
        for index, result in results:
            trial = missing[index]
            if isinstance(result, Lost):
                finished = perform.record_broken(trial, LOST, result.reason)
            elif isinstance(result, Finished):
                finished = result
            else:
                finished = unpack(perform, parcels[index], result)
            found[trial.name] = finished
            if finished.broken:
                _logger.warning("%s: %s: %s", trial.name, finished.outcome, finished.reason)
            show(title, len(found), len(trials), f"{trial.name} {finished.outcome}")
    return [found[trial.name] for trial in trials]
