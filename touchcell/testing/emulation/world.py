"""The emulators of a cell, started with its run and stopped with it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import EMULATED_CAMERAS, plan_cell, plan_in_world
from touchcell.cell.runtime.worlds import Emulation
from touchcell.drivers.core.paced_clock import pace_variables
from touchcell.errors import ConfigError, suggest
from touchcell.testing.emulation.in_cell import EMULATED
from touchcell.testing.emulation.process import EmulatorProcess

_START_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class EmulatedCell:
    """A cell whose emulators run.

    Attributes:
        plan: the cell, with the emulators' addresses.
        process: its emulators; they take faults as ``DEVICE.FAULT``.
    """

    plan: CellPlan
    process: EmulatorProcess

    def inject(self, device: str, faults: Mapping[str, Any]) -> None:
        """Begin faults of a device, by the names that simulated devices have for them.

        Raises:
            ConfigError: the device's emulator has no such fault.
        """
        known = self._faults(device)
        for name, value in faults.items():
            if name not in known:
                raise ConfigError(
                    f"no fault {name!r} on an emulated {self.plan.devices[device].spec.name}",
                    key=device,
                    value=name,
                    hint=suggest(name, known),
                )
            fault, of_value = known[name]
            self.process.fault(f"{device}.{fault}", of_value(value))

    def clear(self, device: str) -> None:
        """End all faults of a device."""
        for fault, _ in self._faults(device).values():
            self.process.clear(f"{device}.{fault}")

    def _faults(self, device: str) -> Mapping[str, tuple[str, Callable[[Any], Any]]]:
        return EMULATED.load(self.plan.devices[device].spec.name).faults


@contextmanager
def emulated(
    path: Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Iterator[CellPlan]:
    """Start the emulators of a cell and yield its plan; see ``running_emulators``."""
    with running_emulators(path, overrides, model=model, settings=settings) as cell:
        yield cell.plan


@contextmanager
def running_emulators(
    path: Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Iterator[EmulatedCell]:
    """Start the emulators of a cell with the scene around them; they end with the context.

    Args:
        path: the cell file.
        overrides, model, settings: see ``plan_cell``.

    Raises:
        ConfigError: a device has no emulator; see ``plan_in_world``.
        ConnectError, TransportTimeout: an emulator does not start.
    """
    with tempfile.TemporaryDirectory(prefix="touchcell-emulated-") as name:
        folder = Path(name)
        plan = plan_emulated(path, folder, overrides, model=model, settings=settings)
        file = folder / "cell.yaml"
        file.write_text(plan.text())
        variables = {EMULATED_CAMERAS: str(folder), **pace_variables(plan.cell.emulated_pace)}
        arguments = ("cell", str(file), "--folder", str(folder))
        with _environment(variables), EmulatorProcess(*arguments, timeout_s=_START_S) as process:
            yield EmulatedCell(plan, process)


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within the context, for drivers in this process and for emulators in theirs."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def plan_emulated(
    path: Path,
    folder: Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> CellPlan:
    """Plan a cell for emulators at free addresses, with their sockets and links in ``folder``; nothing is started.

    Raises:
        ConfigError: a device has no emulator; see ``plan_in_world``.
    """
    as_written = plan_cell(path, overrides, model=model, settings=settings, to_run=False)
    more: dict[str, Any] = {}
    kinds = {"arms": as_written.arms, "sensors": as_written.sensors, "devices": as_written.auxiliaries}
    for kind, devices in kinds.items():
        for number, (name, device) in enumerate(devices.items()):
            if device.spec.name not in EMULATED.names():
                raise ConfigError(
                    "there is no emulator for it in a cell",
                    file=str(path),
                    key=f"{kind}.{name}.driver",
                    value=device.spec.name,
                    hint=f"known: {', '.join(EMULATED.names())}; or run --on sim",
                )
            found = EMULATED.load(device.spec.name).settings(device.config, folder, number)
            more |= {f"{kind}.{name}.{key}": value for key, value in found.items()}
    return plan_in_world(path, "emulated", overrides, model=model, settings=settings, more=more)


EMULATION = Emulation("emulated", plan_emulated, emulated)
