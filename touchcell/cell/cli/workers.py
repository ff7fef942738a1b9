"""Options of commands that run many trials: how many at a time, where, and how long each may take."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Final

from touchcell.cell.cli.arguments import positive

if TYPE_CHECKING:
    from touchcell.cell.experiments.executors import Workers

_TIME_LIMIT_S: Final = 3600


def add_workers(parser: argparse.ArgumentParser, *, time_limit_s: int = _TIME_LIMIT_S, what: str = "trial") -> None:
    """Declare the options."""
    parser.add_argument("--jobs", type=positive, help=f"{what}s at a time (default: one for each core)")
    parser.add_argument(
        "--executor",
        default="local",
        metavar="NAME[:ADDRESS]",
        help=f"what runs the {what}s; `touchcell list executors` names them (default: %(default)s)",
    )
    parser.add_argument(
        "--time-limit-s",
        type=positive,
        default=time_limit_s,
        metavar="S",
        help=f"longest time for one {what}; it is ended then, and the others go on (default: %(default)s)",
    )
    parser.add_argument("--memory-limit-mb", type=positive, metavar="MB", help=f"address space of one {what}'s process")


def workers_of(options: argparse.Namespace) -> Workers:
    """Return what the options ask for."""
    from touchcell.cell.experiments.executors import Workers

    return Workers(options.jobs or os.cpu_count() or 1, float(options.time_limit_s), options.memory_limit_mb)
