"""Executor of Slurm by submitit: ``--executor slurm:PARTITION``, or ``slurm:local`` to try it without a cluster."""

from __future__ import annotations

import math
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from touchcell.cell.experiments.executors import ExecutorSpec, Lost, Workers
from touchcell.cell.experiments.remote_work import LimitedWork

_POLL_S: Final = 0.2
_RAISED: Final = re.compile(r"[\w.]*(Error|Exception|Exit|Interrupt)\b")


def run(work: Callable[[Any], Any], items: Sequence[Any], workers: Workers) -> Iterator[tuple[int, Any]]:
    """Run each piece of ``work`` as a job of one core; at most ``jobs`` are queued at a time.

    submitit hands work and results over in a folder that this machine and the nodes share: the working directory.
    """
    import submitit

    local = workers.address == "local"
    with tempfile.TemporaryDirectory(prefix=".submitit-", dir=".") as folder:
        executor = submitit.AutoExecutor(folder, cluster="local" if local else "slurm")
        executor.update_parameters(cpus_per_task=1)
        if workers.time_limit_s is not None:
            executor.update_parameters(timeout_min=max(1, math.ceil(workers.time_limit_s / 60.0)))
        if workers.address and not local:
            executor.update_parameters(slurm_partition=workers.address)
        limited = LimitedWork(work, workers.time_limit_s)
        waiting: list[tuple[int, Any]] = list(enumerate(items))[::-1]
        running: dict[int, Any] = {}
        try:
            while waiting or running:
                while waiting and len(running) < workers.jobs:
                    index, item = waiting.pop()
                    running[index] = executor.submit(limited, item)
                ended = [index for index, job in running.items() if job.done()]
                for index in ended:
                    job = running.pop(index)
                    error = job.exception()
                    yield index, job.result() if error is None else Lost(_reason(error))
                if not ended:
                    time.sleep(_POLL_S)
        finally:
            for job in running.values():
                job.cancel(check=False)


def _reason(error: BaseException) -> str:
    """Return the line of submitit's report that names what was raised, or how the job ended."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    raised = [line for line in lines if _RAISED.match(line)]
    return raised[-1] if raised else f"{type(error).__name__}: {lines[0] if lines else 'it left no result'}"


SPEC = ExecutorSpec("slurm", "Slurm by submitit: slurm:PARTITION, or slurm:local for this machine", run)
