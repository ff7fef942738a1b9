"""pytest plugin: the fixture ``cell``, which gives running cells to step; see docs/tutorials/test-a-cell.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from touchcell.cell.config.worlds import WorldName
    from touchcell.testing.cell_under_test import CellUnderTest


class CellFactory(Protocol):
    """What the fixture ``cell`` is."""

    def __call__(
        self,
        file: str | PathLike[str],
        *,
        on: WorldName | None = None,
        set: Mapping[str, Any] | None = None,
        faults: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> CellUnderTest:
        """Return a running cell; it is given back when the test ends."""
        ...


@pytest.fixture
def cell() -> Iterator[CellFactory]:
    """Makes running cells: ``cell("cell.yaml", on="sim", set={"task.depth_mm": 2}, faults={...})``."""
    # Imported where it is used: a test session that needs no cell pays nothing for this plugin.
    from touchcell.cell.config.find import find_cell
    from touchcell.testing.cell_under_test import CellUnderTest
    from touchcell.testing.emulation.world import running_emulators

    with ExitStack() as cells:

        def running(
            file: str | PathLike[str],
            *,
            on: WorldName | None = None,
            set: Mapping[str, Any] | None = None,
            faults: Mapping[str, Mapping[str, Any]] | None = None,
        ) -> CellUnderTest:
            if on != "emulated":
                return cells.enter_context(CellUnderTest(file, on=on, set=set, faults=faults))
            settings = {"on_trip": "wait_for_reset", **(set or {})}
            emulated = cells.enter_context(running_emulators(find_cell(Path(file)), settings=settings))
            return cells.enter_context(CellUnderTest(emulated.plan, faults=faults, emulated=emulated))

        yield running
