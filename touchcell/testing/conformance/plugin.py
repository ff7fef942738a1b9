"""pytest plugin: fixtures of ``suite``, and a table of drivers and checks at the end of the run.

Installed as an entry point of ``pytest11``. It imports nothing of touchcell until a suite runs.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator
from itertools import count
from typing import Any

import pytest

_CHECKS = ("lifecycle", "samples", "commands", "motion", "faults", "frames")
_KEY = "touchcell conformance"
_MAX_WIDTH = 100

pytest.register_assert_rewrite(*(f"touchcell.testing.conformance.{name}" for name in _CHECKS))


def pytest_configure(config: pytest.Config) -> None:
    """Register the result table."""
    config.pluginmanager.register(_Table(), "touchcell conformance table")


@pytest.fixture(scope="class")
def conformance_device(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Provide the device fixture of a suite's class and its emulator."""
    from touchcell.testing.conformance.context import DeviceUnderTest

    suite: Any = request.cls
    folder = tmp_path_factory.mktemp(suite.driver)
    under_test = DeviceUnderTest(suite.rig_function, folder, _address(request.config))
    with under_test.rig.world:
        yield under_test
        under_test.clear()


@pytest.fixture
def conformance_context(request: pytest.FixtureRequest, conformance_device: Any) -> Iterator[Any]:
    """Provide the context of a check."""
    from touchcell.testing.conformance.context import ConformanceContext

    needs: Any = getattr(request.function, "conformance", None)
    reason = needs.missing(conformance_device.rig) if needs is not None else None
    if reason is not None:
        pytest.skip(reason)
    if known := conformance_device.rig.known.get(request.node.name.removeprefix("test_")):
        request.applymarker(pytest.mark.xfail(reason=known, strict=True))
    context = ConformanceContext(conformance_device)
    yield context
    report = request.node.stash.get(_FAILED, None)
    context.spoiled = context.spoiled or report is not None
    context.close()


_FAILED = pytest.StashKey[bool]()
_NUMBERS = pytest.StashKey[Any]()


def _address(config: pytest.Config) -> int:
    """Return a number unique on this machine, so that suites may run side by side."""
    number: int = next(config.stash.setdefault(_NUMBERS, count(1)))
    return 1000 + (os.getpid() % 30_000) * 16 + number % 16


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Mark a failed check, so that its emulator is not reused; name it for the table."""
    report: Any = yield
    driver = getattr(getattr(item, "cls", None), "driver", None)
    if driver is not None and hasattr(getattr(item, "function", None), "conformance"):
        if report.failed:
            item.stash[_FAILED] = True
        report.user_properties.append((_KEY, [driver, item.name.removeprefix("test_")]))
    return report


class _Table:
    """Collect the result of each check and print it: green, skipped, known failure, RED."""

    def __init__(self) -> None:
        self._marks: dict[str, dict[str, str]] = {}
        self._reasons: dict[str, list[str]] = {}
        self._seconds: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record one phase of one check."""
        for key, value in report.user_properties:
            if key == _KEY and isinstance(value, list):
                driver, name = value
                self._note(report, driver, name)
                return

    def _note(self, report: pytest.TestReport, driver: str, name: str) -> None:
        self._seconds[driver] = self._seconds.get(driver, 0.0) + report.duration
        marks = self._marks.setdefault(name, {})
        if hasattr(report, "wasxfail") and report.skipped:
            marks[driver] = "known"
            self._explain(f"known {driver} {name}", report.wasxfail)
        elif report.failed:
            if marks.get(driver) != "RED":
                self._explain(f"RED {driver} {name}", str(report.longrepr).strip().splitlines()[-1])
            marks[driver] = "RED"
        elif report.skipped:
            # A driver may have several rigs: what one cannot show another may.
            marks.setdefault(driver, "-")
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
            self._explain(f"- {reason.removeprefix('Skipped: ')}", f"{driver}: {name}")
        elif report.when == "call" and marks.get(driver, "-") == "-":
            marks[driver] = "green"

    def _explain(self, title: str, line: str) -> None:
        self._reasons.setdefault(title, []).append(line[:_MAX_WIDTH])

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print the table, if any check ran."""
        if not self._marks:
            return
        drivers = sorted(self._seconds)
        widths = [max(len(driver), 5) + 2 for driver in drivers]
        names = max(len(name) for name in self._marks)
        write = terminalreporter.write_line
        terminalreporter.section("conformance")
        write(" " * names + "".join(f"{driver:>{width}}" for driver, width in zip(drivers, widths, strict=True)))
        for name, marks in self._marks.items():
            cells = (f"{marks.get(driver, ''):>{width}}" for driver, width in zip(drivers, widths, strict=True))
            write(f"{name:<{names}}" + "".join(cells))
        totals = (f"{self._seconds[d]:{width - 2}.1f} s" for d, width in zip(drivers, widths, strict=True))
        write(f"{'time':<{names}}" + "".join(totals))
        write("")
        for title, lines in sorted(self._reasons.items(), key=lambda entry: entry[0].startswith("-")):
            write(title)
            for line in [_by_driver(lines)] if title.startswith("-") else lines:
                write(f"    {line}")


def _by_driver(lines: list[str]) -> str:
    found: dict[str, int] = {}
    for line in lines:
        driver = line.partition(":")[0]
        found[driver] = found.get(driver, 0) + 1
    return ", ".join(f"{driver} ({number})" for driver, number in sorted(found.items()))
