"""Emulators that take the place of a cell's devices: what changes in the device's section, and how it is started."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, Final, TypeAlias

from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.core.spec import DriverConfig
from touchcell.geometry.types import Array
from touchcell.registry import Registry
from touchcell.testing.emulation.process import EmulatorProcess

_FIRST: Final = IPv4Address("127.1.0.0")
_HOSTS_PER_PROCESS: Final = 16
_DEVICES: Final = 4
_PROCESSES: Final = 1_000_000


TcpOfJoints: TypeAlias = Callable[[Array], Array]


@dataclass(frozen=True, slots=True)
class EmulatedDriver:
    """How a driver's device is emulated within a cell.

    Attributes:
        name: of the driver.
        settings: keys of the device's section that lead its driver to the emulator, from its configuration, the folder
            for sockets and links, and the number of the device in the cell.
        start: makes the emulator of an arm, not started yet, from that configuration and the joint angles in degrees at
            which it begins (None for its home); None for a camera, whose picture the scene draws.
        T_base_tcp: returns for a configuration and the state of the emulator at its start what computes the pose (4, 4)
            of an arm's tool in its base from the joint angles (n,) rad that the emulator publishes.
        faults: by a fault of simulated devices (``touchcell.simulation.faults``) the emulator's own that does the same,
            and its value for a value of the simulated one.
    """

    name: str
    settings: Callable[[Any, Path, int], Mapping[str, Any]]
    start: Callable[[Any, Sequence[float] | None], EmulatorProcess] | None = None
    T_base_tcp: Callable[[Any, Mapping[str, Any]], TcpOfJoints] | None = None
    faults: Mapping[str, tuple[str, Callable[[Any], Any]]] = field(default_factory=dict)


EMULATED: Final = Registry("touchcell.emulated_devices", "emulated device", EmulatedDriver)
"""Drivers whose devices are emulated within a cell."""


def free_host(port: int, number: int) -> str:
    """Return a loopback address of this process's own, for its device ``number``, on which ``port`` is free.

    Raises:
        ConnectError: something else listens on all of them.
    """
    first = _FIRST + os.getpid() % _PROCESSES * _HOSTS_PER_PROCESS + number
    for step in range(0, _HOSTS_PER_PROCESS - number, _DEVICES):
        host = str(first + step)
        with suppress(OSError), socket.socket() as wire:
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            wire.bind((host, port))
            return host
    raise ConnectError("emulator", f"port {port} is taken on {first} and its neighbours")


def tcp_of_joints(config: DriverConfig, state: Mapping[str, Any]) -> TcpOfJoints:
    """Return what computes the tool's pose (4, 4) from joint angles (n,) rad, by the configured chain.

    A controller has the configured tool only once its arm is active; the chain has it from the start.
    """
    chain = config.described_chain()
    assert chain is not None
    return chain.forward


FOR_EVER_S: Final = 3600.0
FOR_EVER_PACKETS: Final = 1_000_000


def start_arguments(start_deg: Sequence[float] | None) -> list[str]:
    """Return the option that starts an emulated arm at these joint angles."""
    return [] if start_deg is None else ["--start-deg", *(f"{angle:.6f}" for angle in start_deg)]
