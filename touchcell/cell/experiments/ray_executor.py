"""Executor of Ray: ``--executor ray`` starts Ray here, ``ray:ADDRESS`` joins a cluster."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from touchcell.cell.experiments.executors import ExecutorSpec, Lost, Workers
from touchcell.cell.experiments.remote_work import LimitedWork


def run(work: Callable[[Any], Any], items: Sequence[Any], workers: Workers) -> Iterator[tuple[int, Any]]:
    """Run ``work`` as Ray tasks of one core each, without retries."""
    import cloudpickle
    import ray

    # Ray has a cloudpickle of its own.
    for module in cloudpickle.list_registry_pickle_by_value():
        ray.cloudpickle.register_pickle_by_value(sys.modules[module])
    here = {} if workers.address else {"num_cpus": workers.jobs, "include_dashboard": False}
    ray.init(address=workers.address or "local", log_to_driver=False, logging_level=logging.WARNING, **here)
    try:
        limited = LimitedWork(work, workers.time_limit_s)

        def call(item: Any) -> Any:
            return limited(item)

        task = ray.remote(num_cpus=1, max_retries=0)(call)
        running = {task.remote(item): index for index, item in enumerate(items)}
        while running:
            (done, *_), _ = ray.wait(list(running))
            index = running.pop(done)
            try:
                yield index, ray.get(done)
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                yield index, Lost(f"{type(cause).__name__}: {str(cause).strip().splitlines()[0]}")
    finally:
        ray.shutdown()


SPEC = ExecutorSpec("ray", "Ray: started here, or ray:ADDRESS of a cluster", run)
