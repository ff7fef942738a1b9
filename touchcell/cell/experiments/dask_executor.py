"""Executor of dask.distributed: ``--executor dask`` starts workers here, ``dask:ADDRESS`` uses a scheduler."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any

from touchcell.cell.experiments.executors import ExecutorSpec, Lost, Workers
from touchcell.cell.experiments.remote_work import LimitedWork


def run(work: Callable[[Any], Any], items: Sequence[Any], workers: Workers) -> Iterator[tuple[int, Any]]:
    """Run ``work`` on dask workers, one thread each; a worker that dies costs the piece of work that it had.

    No more is submitted than there are threads: what waits at a worker that dies would be lost with it.
    """
    import dask
    from distributed import Client, LocalCluster, as_completed

    with dask.config.set(
        {
            "distributed.scheduler.allowed-failures": 0,
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.worker.daemon": False,
        }
    ):
        cluster = (
            None
            if workers.address
            else LocalCluster(
                n_workers=max(1, min(workers.jobs, len(items))), threads_per_worker=1, dashboard_address=None
            )
        )
        try:
            with Client(workers.address or cluster) as client:
                limited = LimitedWork(work, workers.time_limit_s)
                waiting = iter(enumerate(items))
                running: dict[str, int] = {}
                futures = as_completed()

                def submit() -> None:
                    threads = sum(client.nthreads().values())
                    for index, item in islice(waiting, max(max(threads, 1) - len(running), 0)):
                        future = client.submit(limited, item, pure=False)
                        running[future.key] = index
                        futures.add(future)

                submit()
                for future in futures:
                    error = future.exception()
                    index = running.pop(future.key)
                    # Also for workers that have joined meanwhile.
                    submit()
                    yield index, future.result() if error is None else Lost(f"{type(error).__name__}: {error}")
        finally:
            if cluster is not None:
                cluster.close()


SPEC = ExecutorSpec("dask", "dask.distributed: workers of its own, or dask:ADDRESS of a scheduler", run)
