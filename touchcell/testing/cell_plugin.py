"""pytest plugin: the fixture ``cell``, which gives running cells to step; see docs/tutorials/test-a-cell.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from os import PathLike
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from touchcell.testing.cell_under_test import CellUnderTest


class CellFactory(Protocol):
    """What the fixture ``cell`` is."""

    def __call__(
        self,
        file: str | PathLike[str],
        *,
        set: Mapping[str, Any] | None = None,
        faults: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> CellUnderTest:
        """Return a running cell; it is given back when the test ends."""
        ...


@pytest.fixture
def cell() -> Iterator[CellFactory]:
    """Makes running cells: ``cell("cell.yaml", set={"task.depth_mm": 2}, faults={"arm": {"stale": True}})``."""
    # Imported where it is used: a test session that needs no cell pays nothing for this plugin.
    from touchcell.testing.cell_under_test import CellUnderTest

    with ExitStack() as cells:

        def running(
            file: str | PathLike[str],
            *,
            set: Mapping[str, Any] | None = None,
            faults: Mapping[str, Mapping[str, Any]] | None = None,
        ) -> CellUnderTest:
            return cells.enter_context(CellUnderTest(file, set=set, faults=faults))

        yield running
