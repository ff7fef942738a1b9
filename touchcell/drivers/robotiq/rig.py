"""Test fixture: the ``robotiq`` driver with an emulated gripper, over Modbus TCP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, Final

from touchcell.drivers.robotiq import driver
from touchcell.drivers.robotiq.driver import SPEC, RobotiqConfig, RobotiqGripper
from touchcell.testing.emulation.in_cell import EmulatedDriver, free_host
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

TCP_PORT: Final = 1502
"""Port of emulated gateways; a real one's, 502, needs a privilege."""


def host_of(address: int) -> str:
    """Return the loopback address of emulator ``address``."""
    return str(IPv4Address("127.208.0.1") + address)


def _arguments(host: str) -> tuple[str, ...]:
    return "--host", host, "--tcp-port", str(TCP_PORT)


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build a gripper at a loopback address of its own; it stores nothing in ``folder``."""
    config = RobotiqConfig(host=host_of(address), tcp_port=TCP_PORT)
    return DeviceFixture(
        spec=SPEC,
        start=lambda: EmulatorProcess("robotiq", *_arguments(host_of(address))).start(),
        build=lambda clock: RobotiqGripper("gripper", config, clock),
        config=config,
        configured=lambda other, clock: RobotiqGripper("gripper", other, clock),
        position=None,
        reset="reset",
        faults={
            "drop": (2, "transient"),
            "corrupt": (2, "transient"),
            "pause": (True, "fault"),
            "fault": (0x0E, "fault"),
            "restart": (True, "fault"),
            "unplug": (True, "fault"),
        },
        notes=("registers and fault codes are known from Robotiq's manual; no gripper was at hand",),
    )


def rig_in_step(folder: Path, address: int) -> DeviceFixture:
    """Build the same gripper on a simulated time, which the emulator shares with the driver."""
    world = Lockstep([driver])
    return replace(
        rig(folder, address),
        start=lambda: emulator_in_step(world, "robotiq", *_arguments(host_of(address))).start(),
        world=world,
        clock=lambda: world,
        reachable=False,
    )


def _settings(config: RobotiqConfig, folder: Path, number: int) -> Mapping[str, Any]:
    return {"port": None, "host": free_host(TCP_PORT, number), "tcp_port": TCP_PORT}


def _start(config: RobotiqConfig, start_deg: object) -> EmulatorProcess:
    assert config.host is not None
    return EmulatorProcess("robotiq", *_arguments(config.host))


EMULATED = EmulatedDriver("robotiq", _settings, _start)
