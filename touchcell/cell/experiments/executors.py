"""What runs many independent pieces of work: processes of this machine, or workers elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class Lost:
    """Takes the place of a result whose worker ended before it: it was killed, ran out of memory or of time.

    Attributes:
        reason: in one sentence.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class Workers:
    """How much of an executor to use.

    Attributes:
        jobs: pieces of work at a time.
        time_limit_s: of each piece, in wall-clock time; None for none.
        memory_limit_mb: of each worker's address space, where the executor can limit it; None for none.
        address: what follows the executor's name and a colon: a scheduler, a partition.
    """

    jobs: int = 1
    time_limit_s: float | None = None
    memory_limit_mb: int | None = None
    address: str = ""


class Executor(Protocol):
    """Runs pieces of work somewhere."""

    def __call__(
        self, work: Callable[[Any], Any], items: Sequence[Any], workers: Workers, /
    ) -> Iterator[tuple[int, Any]]:
        """Yield (index, ``work(items[index])``) for every item, in the order in which they finish.

        A piece of work that ends without a result yields ``Lost``; the others continue. ``work`` and the items are
        pickled. Closing the iterator, or an interrupt, ends what runs.
        """
        ...


@dataclass(frozen=True, slots=True)
class ExecutorSpec:
    """Entry point of an executor (group ``touchcell.executors``).

    Attributes:
        name: value of ``--executor`` on the command line.
        summary: one line for ``touchcell list``.
        run: the executor.
        shares_files: True if workers see the files of this machine; otherwise inputs and results travel by value.
    """

    name: str
    summary: str
    run: Executor
    shares_files: bool = False


EXECUTORS: Final = Registry("touchcell.executors", "executor", ExecutorSpec)
"""All installed executors."""
