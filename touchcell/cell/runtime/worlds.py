"""A planned cell in one of its worlds, with what that world needs running around it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import plan_in_world
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.runtime.bench_lock import bench_lock
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class Emulation:
    """Entry point of what emulates a cell; nothing that runs on a bench imports it.

    Attributes:
        name: of the world.
        plan: plans a cell for emulators with their sockets in a folder, and starts nothing.
        start: plans a cell and runs its emulators within a context.
    """

    name: str
    plan: Callable[..., CellPlan]
    start: Callable[..., AbstractContextManager[CellPlan]]


EMULATIONS: Final = Registry("touchcell.emulations", "emulation", Emulation)
"""What emulates cells."""


@contextmanager
def cell_in_world(
    path: str | PathLike[str],
    world: WorldName | None,
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Iterator[CellPlan]:
    """Plan a cell for a world, and keep its emulators running within the context.

    Args:
        path: the cell file.
        world: where it runs; None as the file is written.
        overrides, model, settings: see ``plan_cell``.

    Raises:
        ConfigError: see ``plan_in_world``.
        BenchTaken: another process uses a device of the bench.
        ConnectError, TransportTimeout: an emulator does not start.
    """
    if world != "emulated":
        plan = plan_in_world(path, world, overrides, model=model, settings=settings)
        with bench_lock(plan) if world == "bench" else nullcontext():
            yield plan
        return
    with EMULATIONS.load("emulated").start(Path(path), overrides, model=model, settings=settings) as plan:
        yield plan


def plan_for(
    path: str | PathLike[str],
    world: WorldName | None,
    overrides: Mapping[str, Any] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
) -> CellPlan:
    """Plan a cell for a world, and start nothing. Raises ConfigError as ``plan_in_world``."""
    if world != "emulated":
        return plan_in_world(path, world, overrides, settings=settings)
    folder = Path(tempfile.gettempdir())
    return EMULATIONS.load("emulated").plan(Path(path), folder, overrides, settings=settings)
