"""Test fixture: the ``net_ft`` driver with an emulated box."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from touchcell.drivers.net_ft import codec, driver
from touchcell.drivers.net_ft.driver import SPEC, NetFt, NetFtConfig
from touchcell.testing.emulation.in_cell import EmulatedDriver, free_host
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture


def host_of(address: int) -> str:
    """Return the loopback address of emulator ``address``: the box's ports are fixed, so each needs its own."""
    return str(IPv4Address("127.176.0.1") + address)


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build a box at a loopback address of its own; it stores nothing in ``folder``."""
    config = NetFtConfig(host=host_of(address), max_silence_s=0.3)
    return DeviceFixture(
        spec=SPEC,
        start=lambda: EmulatorProcess("net_ft", "--host", config.host).start(),
        build=lambda clock: NetFt("ft", config, clock),
        config=config,
        configured=lambda other, clock: NetFt("ft", other, clock),
        position=None,
        faults={
            "drop": (3, "transient"),
            "short": (3, "transient"),
            "out_of_order": (3, "transient"),
            "pause": (True, "fault"),
            "stuck": (True, "fault"),
            "status": (0x80020000, "fault"),
            "unplug": (True, "fault"),
        },
        notes=("the protocol is known from ATI's manual and public clients; no box was at hand",),
    )


def rig_in_step(folder: Path, address: int) -> DeviceFixture:
    """Build the same box on a simulated time, which the emulator shares with the driver."""
    world = Lockstep([driver])
    return replace(
        rig(folder, address),
        start=lambda: emulator_in_step(world, "net_ft", "--host", host_of(address)).start(),
        world=world,
        clock=lambda: world,
        reachable=False,
    )


def _settings(config: NetFtConfig, folder: Path, number: int) -> Mapping[str, Any]:
    return {"host": free_host(codec.CALIBRATION_PORT, number)}


def _start(config: NetFtConfig, start_deg: object) -> EmulatorProcess:
    return EmulatorProcess("net_ft", "--host", config.host)


EMULATED = EmulatedDriver("net_ft", _settings, _start)
