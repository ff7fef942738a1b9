"""pytest plugin of the modules that ``touchcell new hil CELL`` writes: their world, their cell, and their evidence.

They run in simulation unless ``--on`` names another world. ``-m hil`` runs them on the bench, where an operator is
asked first and the devices are locked. Installed as an entry point of ``pytest11``.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import pytest

from touchcell.testing.hil import is_generated

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan
    from touchcell.testing.cell_under_test import CellUnderTest

BENCH_TAKEN: Final = 10
"""Exit code when somebody else uses the bench."""


@dataclass(frozen=True)
class Conformance:
    """In a generated module: stands for the conformance suite of one device of its cell, at creeping speed.

    Attributes:
        cell: the cell file, relative to the module.
        device: name of the device.
    """

    cell: str
    device: str


@dataclass
class _World:
    """A cell in the world of this session, started when the first test needs it."""

    file: Path
    name: str
    pace: float = 1.0
    stack: ExitStack = field(default_factory=ExitStack)
    started: CellPlan | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stack.close()

    def end(self) -> None:
        """End it; the next call of ``plan`` starts it afresh."""
        self.stack.close()
        self.stack, self.started = ExitStack(), None

    def plan(self) -> CellPlan:
        """Return the plan; its emulators run and its bench is locked from the first call on."""
        if self.started is None:
            from touchcell.cell.runtime.worlds import cell_in_world

            settings = {"on_trip": "wait_for_reset", "emulated_pace": self.pace}
            self.started = self.stack.enter_context(cell_in_world(self.file, self.name, settings=settings))  # type: ignore[arg-type]
        return self.started


_WORLDS = pytest.StashKey[dict[Path, _World]]()
_AGREED = pytest.StashKey[set[Path]]()
_EVIDENCE: Final = pytest.StashKey[Any]()
_SLOWER: Final = (1.0, 0.5, 0.25)
"""Shares of the session's pace at which a test is tried, one after the other."""
_OVERRUN: Final = "overrun"
_CELL = pytest.StashKey["CellUnderTest"]()
_FRESH = pytest.StashKey[ExitStack]()
_REPEATED = pytest.StashKey[list[tuple[str, float]]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--on``, ``--pace`` and ``--hil-report``."""
    group = parser.getgroup("touchcell")
    group.addoption("--on", choices=("sim", "emulated"), default="sim", help="world of generated tests (default: sim)")
    group.addoption("--pace", type=float, default=1.0, help="emulated seconds in each second of this machine, up to 1")
    group.addoption("--hil-report", type=Path, metavar="FILE", help="write evidence of generated tests as HTML")


def pytest_configure(config: pytest.Config) -> None:
    """Prepare worlds and evidence."""
    config.stash[_WORLDS] = {}
    config.stash[_AGREED] = set()


def pytest_unconfigure(config: pytest.Config) -> None:
    """End the worlds."""
    for world in config.stash.get(_WORLDS, {}).values():
        world.stack.close()


def _world_name(config: pytest.Config) -> str:
    on_bench = "hil" in config.option.markexpr.replace("not hil", "")
    return "bench" if on_bench else str(config.getoption("--on"))


def _world(config: pytest.Config, module: Path, cell: str) -> _World:
    from touchcell.cell.config.find import find_cell

    file = find_cell((module.parent / cell).resolve())
    return config.stash[_WORLDS].setdefault(file, _World(file, _world_name(config), config.getoption("--pace")))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark generated tests as ``hil`` where they run on the bench."""
    if _world_name(config) == "bench":
        for item in items:
            if is_generated(item):
                item.add_marker(pytest.mark.hil)


def pytest_pycollect_makeitem(collector: Any, name: str, obj: object) -> pytest.Collector | None:
    """Collect a ``Conformance`` as the suite of its device."""
    if not isinstance(obj, Conformance):
        return None
    from touchcell.testing.conformance.suite import suite
    from touchcell.testing.hil import rig_in

    world = _world(collector.config, collector.path, obj.cell)
    tests: Any = suite(rig_in(world.file, world.plan, obj.device, _world_name(collector.config), world.end))
    tests.driver, tests.generated_from = obj.device, world.file
    setattr(collector.obj, name, tests)
    collected: pytest.Collector = pytest.Class.from_parent(collector, name=name, obj=tests)
    return collected


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """On the bench: ask the operator once for each cell, and lock its devices."""
    if _world_name(item.config) != "bench" or not is_generated(item):
        return
    from touchcell.cell.runtime.bench_lock import BenchTaken
    from touchcell.testing.hil import ask

    world = _world(item.config, item.path, item.module.CELL)  # type: ignore[attr-defined]
    agreed = item.config.stash[_AGREED]
    if world.file in agreed:
        return
    if not item.config.getoption("--hil-yes"):
        ask(item.config, f"the arms of {world.file.name}", "and press what the task presses, at the speeds of the file")
    try:
        world.plan()
    except BenchTaken as error:
        pytest.exit(str(error), returncode=BENCH_TAKEN)
    agreed.add(world.file)


@pytest.fixture
def hil_cell(request: pytest.FixtureRequest) -> Iterator[CellUnderTest]:
    """Provide the running cell of a generated module, in the world of this session."""
    with ExitStack() as fresh:
        yield _begun(request.node, fresh)


def _begun(item: pytest.Item, fresh: ExitStack, slower: float = 1.0) -> CellUnderTest:
    """Return the running cell of an item, given back with ``fresh``, emulated ``slower`` times the session's pace."""
    from touchcell.testing.cell_under_test import CellUnderTest

    item.stash[_FRESH] = fresh
    world = _world(item.config, item.path, item.module.CELL)  # type: ignore[attr-defined]
    if world.name == "emulated":
        # Emulated arms stay where the test before has left them.
        world = fresh.enter_context(_World(world.file, world.name, slower * world.pace))
    item.stash[_CELL] = running = fresh.enter_context(CellUnderTest(world.plan()))
    return running


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test on emulators again, at half the pace, where this machine has kept its loop from a control cycle."""
    if "hil_cell" not in pyfuncitem.funcargs or _world_name(pyfuncitem.config) != "emulated":
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    for slower in _SLOWER:
        try:
            pyfuncitem.obj(**arguments)
        except Exception:
            if pyfuncitem.stash[_CELL].tripped_by != _OVERRUN or slower == _SLOWER[-1]:
                raise
        else:
            return True
        pyfuncitem.stash[_FRESH].close()
        pace = 0.5 * slower * pyfuncitem.config.getoption("--pace")
        pyfuncitem.config.stash.setdefault(_REPEATED, []).append((pyfuncitem.name, pace))
        arguments["hil_cell"] = pyfuncitem.funcargs["hil_cell"] = _begun(pyfuncitem, ExitStack(), 0.5 * slower)
    raise AssertionError("unreachable")


def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Give back the cell of a test that was repeated."""
    if (fresh := item.stash.get(_FRESH, None)) is not None:
        fresh.close()


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say which tests were repeated at which pace."""
    for name, pace in config.stash.get(_REPEATED, []):
        terminalreporter.write_line(
            f"{name}: repeated at a pace of {pace:g}: this machine was late for a control cycle"
        )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Keep what the evidence is made of."""
    report: Any = yield
    if item.config.getoption("--hil-report") is not None and is_generated(item):
        shows = report.when == "call" or report.outcome != "passed"
        if shows:
            from touchcell.testing.evidence import Evidence

            evidence = item.config.stash.setdefault(_EVIDENCE, Evidence(_world_name(item.config)))
            file = _world(item.config, item.path, item.module.CELL).file  # type: ignore[attr-defined]
            evidence.add(item.nodeid, item.obj.__doc__ or "", report, file, item.stash.get(_CELL, None))  # type: ignore[attr-defined]
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the evidence."""
    path = session.config.getoption("--hil-report")
    if path is not None and (evidence := session.config.stash.get(_EVIDENCE, None)) is not None:
        evidence.write(path)
