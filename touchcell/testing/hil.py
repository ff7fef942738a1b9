"""pytest plugin: run the conformance suite on real hardware, ``pytest -m hil --cell bench.yaml``.

Every device of the cell file is tested at no more than 5 mm/s. The operator confirms each arm first; ``--hil-yes``
skips the question. Installed as an entry point of ``pytest11``; without ``--cell`` it only deselects ``hil`` tests.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan, DevicePlan
    from touchcell.drivers.core.clock import Clock
    from touchcell.drivers.core.device import Device
    from touchcell.testing.emulation.rig import DeviceFixture, FixtureFactory

_SHORT_MOVES = "and, if it is an arm, move about 10 mm along and 2 deg about every axis"
_CONFIRMED = pytest.StashKey[set[str]]()
_CELL = pytest.StashKey[Path | None]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--cell`` and ``--hil-yes``."""
    group = parser.getgroup("touchcell")
    group.addoption("--cell", type=Path, help="cell file, or name of one that ships: `hil` tests run on its devices")
    group.addoption("--hil-yes", action="store_true", help="run `hil` tests without asking the operator")


def pytest_configure(config: pytest.Config) -> None:
    """Collect the cell file as one more test file."""
    config.addinivalue_line("markers", "hil: moves a real device; needs --cell")
    config.stash[_CONFIRMED] = set()
    config.stash[_CELL] = None
    if given := config.getoption("--cell"):
        from touchcell.cell.config.find import find_cell

        cell = find_cell(given).resolve()
        if not cell.is_file():
            raise pytest.UsageError(f"--cell {given}: no such file, and no cell of that name ships (`touchcell list`)")
        config.stash[_CELL] = cell
        config.args.append(str(cell))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect `hil` tests without a cell file."""
    if config.getoption("--cell"):
        return
    on_hardware = [item for item in items if item.get_closest_marker("hil") and not is_generated(item)]
    if on_hardware:
        config.hook.pytest_deselected(items=on_hardware)
        items[:] = [item for item in items if item not in on_hardware]


def is_generated(item: pytest.Item) -> bool:
    """Return whether the test is of a module that ``touchcell new hil`` has written, which names its own cell."""
    return "hil_cell" in getattr(item, "fixturenames", ()) or hasattr(getattr(item, "cls", None), "generated_from")


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect the cell file as a module of suites."""
    if file_path != parent.config.stash[_CELL]:
        return None
    return CellModule.from_parent(parent, path=file_path)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Ask the operator once per device."""
    device = getattr(getattr(item, "cls", None), "driver", None)
    confirmed = item.config.stash[_CONFIRMED]
    if device is None or device in confirmed or is_generated(item) or not item.get_closest_marker("hil"):
        return
    if not item.config.getoption("--hil-yes"):
        ask(item.config, device)
    confirmed.add(device)


class CellModule(pytest.Module):
    """A cell file, with one suite for each of its devices."""

    def _getobj(self) -> ModuleType:
        from touchcell.cell.config.schema import plan_cell
        from touchcell.testing.conformance.suite import suite

        plan = plan_cell(self.path)
        module = ModuleType(self.path.stem)
        for name, device in plan.devices.items():
            tests: Any = suite(_rig_of(plan, device))
            tests.driver = name
            tests.pytestmark = [pytest.mark.hil]
            setattr(module, f"Test_{name}", tests)
        return module


def _rig_of(plan: CellPlan, device: DevicePlan) -> FixtureFactory:
    """Build a device fixture with no emulator and no ground truth."""
    from touchcell.cell.runtime.devices import build_devices
    from touchcell.drivers.core.clock import VirtualClock
    from touchcell.drivers.core.paced_clock import emulated_clock
    from touchcell.testing.emulation.rig import DeviceFixture

    def rig(folder: Path, address: int) -> DeviceFixture:
        return DeviceFixture(
            spec=device.spec,
            start=None,
            build=lambda clock: build_devices(plan, plan.devices, clock)[device.name],
            energising=None,
            position=None,
            state_rate_hz=getattr(device.config, "rate_hz", None) or _scene_rate_hz(plan, device),
            clock=VirtualClock if plan.cell.time == "simulated" else emulated_clock,
            process=False,
        )

    return rig


def _scene_rate_hz(plan: CellPlan, device: DevicePlan) -> float | None:
    """Return the state rate of an arm that is sampled in the steps of the cell's scene, else None."""
    able = device.spec.capabilities
    if plan.cell.scene is None or able.kind != "arm" or not able.virtual_time:
        return None
    from touchcell.simulation.scene import SceneConfig

    return 1e3 / SceneConfig.model_validate(plan.cell.scene).step_ms


def rig_in(
    file: Path, plan: Callable[[], CellPlan], device: str, world: str, restart: Callable[[], None]
) -> FixtureFactory:
    """Return the fixture of one device of a cell in a world, without ground truth.

    Args:
        file: the cell file.
        plan: returns its plan; emulators run and the bench is locked from its first call on.
        device: name of the device.
        world: where it runs.
        restart: ends the world, so that the next call of ``plan`` starts it afresh.
    """
    from touchcell.cell.config.schema import plan_in_world

    known = plan_in_world(file, world)  # type: ignore[arg-type]

    def rig(folder: Path, address: int) -> DeviceFixture:
        found = _rig_of(known, known.devices[device])(folder, address)

        def build(clock: Clock) -> Device:
            started = plan()
            return _rig_of(started, started.devices[device])(folder, address).build(clock)

        def clock() -> Clock:
            # Called once for each check. An arm without brakes has fallen at the end of the one before.
            if world == "emulated" and found.spec.capabilities.falls_on_power_loss:
                restart()
            # The emulators' time begins with them.
            plan()
            return found.clock()

        return replace(found, build=build, clock=clock)

    return rig


def ask(config: pytest.Config, device: str, what: str = _SHORT_MOVES) -> None:
    """Ask the operator before a device is powered; end the session without consent."""
    capture = config.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        if sys.stdin is not None and sys.stdin.isatty():
            print(f"\n{device} will be powered {what}.")
            print(
                "Is the space around it free, are people away, and is a hand on the emergency stop? Type yes: ", end=""
            )
        try:
            answer = input()
        except (EOFError, OSError):
            # Standard input is not a terminal, or belongs to a worker.
            answer = None
    if answer is None:
        pytest.exit(
            "tests on a bench ask a person first: run them in a terminal and without -n, or answer with --hil-yes",
            returncode=pytest.ExitCode.USAGE_ERROR,
        )
    if answer.strip().lower() != "yes":
        pytest.exit(f"the operator did not agree to test {device}", returncode=pytest.ExitCode.INTERRUPTED)
