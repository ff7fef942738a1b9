"""``touchcell recover``: clear the faults of a cell's devices without a run, on a person's request; moves nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.devices import build_devices
from touchcell.cell.runtime.operator_channel import operator_name
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceError

_QUESTION = "Is it safe to clear this fault now? Nothing moves; an arm stays where it is. [yes/no] "


def recover_cell(path: Path, ask: Callable[[str], str] = input, tell: Callable[[str], None] = print) -> bool:
    """Connect the devices of a cell file one after the other and recover those that are faulted.

    Every fault is shown, and recovered only after the answer "yes". No device is activated.

    Args:
        path: the cell file.
        ask: puts a question to the operator and returns the answer.
        tell: prints a line.

    Returns:
        whether no device has a fault any more.

    Raises:
        ConfigError: the cell file is not valid.
    """
    plan = plan_cell(path)
    devices = build_devices(plan, plan.devices)
    recovered = [_recover(device, ask, tell) for device in devices.values()]
    return all(recovered)


def _recover(device: Device, ask: Callable[[str], str], tell: Callable[[str], None]) -> bool:
    try:
        with device:
            if device.state is Lifecycle.PASSIVE:
                with _accept_latched(device):
                    device.configure()
            if device.state is Lifecycle.READY:
                tell(f"{device.name}: no fault")
                return True
            return _recover_faulted(device, ask, tell)
    except DeviceError as error:
        tell(f"{device.name}: {error}")
        return False


@contextmanager
def _accept_latched(device: Device) -> Iterator[None]:
    """Suppress an error that has put ``device`` into FAULTED, where it can be recovered."""
    try:
        yield
    except DeviceError:
        if device.state is not Lifecycle.FAULTED:
            raise


def _recover_faulted(device: Device, ask: Callable[[str], str], tell: Callable[[str], None]) -> bool:
    tell(f"{device.name}: {device.fault}")
    if ask(_QUESTION).strip().lower() != "yes":
        tell(f"{device.name}: left as it is")
        return False
    device.recover(OperatorToken(operator_name(), time.monotonic_ns()))
    tell(f"{device.name}: recovered")
    return True
