"""``touchcell devices`` and ``touchcell probe``: what is plugged in, and whether a cell's devices answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from touchcell import compiled
from touchcell.cell.cli import discovery
from touchcell.cell.cli.discovery import Found
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.runtime.devices import build_devices
from touchcell.cell.runtime.worlds import cell_in_world
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import DeviceError, LifecycleError
from touchcell.drivers.core.protocols import FrameSource, HealthSource, JointSource, TcpSource
from touchcell.geometry import se3

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class Probe:
    """What one device answered while PASSIVE.

    Attributes:
        name, driver: of the device.
        readings: what it reported, as text.
        error: why it could not be reached, or None.
    """

    name: str
    driver: str
    readings: tuple[tuple[str, str], ...]
    error: DeviceError | None = None


def print_devices() -> None:
    """Print every camera, serial port and CAN interface of this machine, and what is missing before it can be used."""
    finders: dict[str, Callable[[], Sequence[Found]]] = {
        "cameras": discovery.cameras,
        "serial ports": discovery.serial_ports,
        "CAN interfaces": discovery.can_interfaces,
    }
    for title, find in finders.items():
        found = find()
        print(f"{title}{'' if found else ': none'}")
        for device in found:
            at = "" if device.node == device.address else f" (now {device.node})"
            print(f"  {device.address}{at}: {device.description}")
            for need in device.needs:
                print(f"    {need}")
    for line in compiled.missing():
        print(line)


def probe_cell(path: Path, settings: Mapping[str, Any] | None = None, world: WorldName | None = None) -> list[Probe]:
    """Connect every device of a cell file one after the other, in PASSIVE only, and ask what it reports.

    Args:
        path: the cell file.
        settings: values in place of the file's own, by dotted key.
        world: where; None as the file is written.

    Raises:
        ConfigError: the cell file is not valid.
    """
    return look_at_devices(_probe, path, settings, world)


def look_at_devices(
    look: Callable[[Device, str], ResultT],
    path: Path,
    settings: Mapping[str, Any] | None = None,
    world: WorldName | None = None,
) -> list[ResultT]:
    """Return what ``look(device, driver)`` returns for every device of a cell file, one after the other.

    The devices are built, not connected. Raises ConfigError as ``probe_cell``.
    """
    with cell_in_world(path, world, settings=settings) as plan:
        devices = build_devices(plan, plan.devices if world is None else plan.built)
        return [look(device, plan.devices[name].spec.name) for name, device in devices.items()]


def print_probes(probes: Sequence[Probe]) -> None:
    """Print what each device reported."""
    for probe in probes:
        print(f"{probe.name} ({probe.driver}): {'passive, answers' if probe.error is None else 'DOES NOT ANSWER'}")
        if probe.error is not None:
            print(f"  {probe.error}")
        width = max((len(name) for name, _ in probe.readings), default=0)
        for name, value in probe.readings:
            print(f"  {name:<{width}}  {value}")


def _probe(device: Device, driver: str) -> Probe:
    readings: list[tuple[str, str]] = []
    try:
        with device:
            for ask in (_tcp, _joints, _frame, _health):
                try:
                    readings += ask(device)
                except LifecycleError:
                    # Some devices tell this only when they are configured, which a probe never does.
                    continue
    except DeviceError as error:
        return Probe(device.name, driver, tuple(readings), error)
    return Probe(device.name, driver, tuple(readings))


def _tcp(device: Device) -> list[tuple[str, str]]:
    if not isinstance(device, TcpSource):
        return []
    pose = np.round(se3.to_euler_mm_deg(device.tcp().value.T_base_tcp), 2).tolist()
    return [("tool at", f"{pose} mm, deg")]


def _joints(device: Device) -> list[tuple[str, str]]:
    if not isinstance(device, JointSource):
        return []
    return [("joints", f"{np.round(np.rad2deg(device.joints().value.q), 2).tolist()} deg")]


def _frame(device: Device) -> list[tuple[str, str]]:
    if not isinstance(device, FrameSource):
        return []
    frame = device.latest()
    shape = frame.value.image.shape
    return [("frame", f"number {frame.seq}, {shape[1]} x {shape[0]}, mean brightness {frame.value.image.mean():.1f}")]


def _health(device: Device) -> list[tuple[str, str]]:
    if not isinstance(device, HealthSource):
        return []
    return [
        (name, f"{value:.6g}" if isinstance(value, float) else str(value)) for name, value in device.health().items()
    ]
