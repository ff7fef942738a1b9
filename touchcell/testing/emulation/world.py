"""The emulators of a cell, started with its run and stopped with it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import EMULATED_CAMERAS, plan_cell, plan_in_world
from touchcell.cell.runtime.worlds import Emulation
from touchcell.drivers.core.paced_clock import pace_variables
from touchcell.errors import ConfigError
from touchcell.testing.emulation.in_cell import EMULATED
from touchcell.testing.emulation.process import EmulatorProcess

_START_S: Final = 60.0


@contextmanager
def emulated(
    path: Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    model: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Iterator[CellPlan]:
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
        with _environment(variables), EmulatorProcess(*arguments, timeout_s=_START_S):
            yield plan


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
