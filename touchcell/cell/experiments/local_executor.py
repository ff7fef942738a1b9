"""Executor that runs trials in processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed

from touchcell.cell.experiments.trials import ExecutorSpec, Finished, Perform, Trial


def run(perform: Perform, trials: Sequence[Trial], jobs: int) -> Iterator[Finished]:
    """Run trials in ``jobs`` processes of this machine; 1 runs them in this process."""
    if jobs == 1 or len(trials) < 2:
        for trial in trials:
            yield perform(trial)
        return
    # Spawned processes: a fork would inherit locks of library threads that do not survive it.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(trials)), context, initializer=_belong_to_parent) as executor:
        running = [executor.submit(perform, trial) for trial in trials]
        try:
            for future in as_completed(running):
                yield future.result()
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def _belong_to_parent() -> None:
    # A terminal's Ctrl-C reaches every process of the group.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A worker whose parent was killed would wait for work forever.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


SPEC = ExecutorSpec("local", "processes of this machine", run)
