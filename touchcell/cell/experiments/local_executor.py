"""Executor of processes of this machine."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from touchcell.cell.experiments.executors import ExecutorSpec, Lost, Workers


def run(work: Callable[[Any], Any], items: Sequence[Any], workers: Workers) -> Iterator[tuple[int, Any]]:
    """Run ``work`` in processes of this machine; with one job and no limits, in this process.

    A process that is killed, hangs or exhausts its memory costs the piece of work that it had.
    """
    if workers.jobs == 1 and workers.time_limit_s is None and workers.memory_limit_mb is None:
        yield from ((index, work(item)) for index, item in enumerate(items))
        return
    from pebble import ProcessExpired, ProcessPool

    # Spawned processes: a fork would inherit locks of library threads that do not survive it.
    pool = ProcessPool(
        max_workers=max(1, min(workers.jobs, len(items))),
        context=multiprocessing.get_context("spawn"),
        initializer=_prepare,
        initargs=[workers.memory_limit_mb],
    )
    try:
        running: dict[concurrent.futures.Future[Any], int] = {
            pool.schedule(work, args=[item], timeout=workers.time_limit_s): index for index, item in enumerate(items)
        }
        for future in concurrent.futures.as_completed(running):
            index = running.pop(future)
            result: Any
            try:
                result = future.result()
            except concurrent.futures.TimeoutError:
                result = Lost(f"took more than {workers.time_limit_s:g} s and was ended")
            except ProcessExpired as error:
                result = Lost(f"its process {_how(error.exitcode)}")
            except Exception as error:  # Work may raise anything; it costs only itself.
                result = Lost(f"raised {type(error).__name__}: {error}")
            yield index, result
    finally:
        pool.stop()  # type: ignore[no-untyped-call]
        pool.join()


def _how(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"was ended by {signal.Signals(-exit_code).name}"
    return f"ended with exit code {exit_code}"


def _prepare(memory_limit_mb: int | None) -> None:
    # A terminal's Ctrl-C reaches every process of the group; the parent ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A worker whose parent was killed would wait for work forever.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # When memory runs out, the kernel ends a worker rather than what waits for it.
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    if memory_limit_mb is not None:
        limit = memory_limit_mb * 1024 * 1024
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


SPEC = ExecutorSpec("local", "processes of this machine", run, shares_files=True)
