"""Test fixture: the ``ur`` driver with an emulated controller."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import CorruptMessage, DeviceGone, TransportError
from touchcell.drivers.core.spec import DriverContext
from touchcell.drivers.ur import control, driver, state
from touchcell.drivers.ur.driver import SPEC, UrArm, UrConfig
from touchcell.drivers.ur.registers import Registers
from touchcell.testing.emulation.in_cell import (
    FOR_EVER_PACKETS,
    FOR_EVER_S,
    EmulatedDriver,
    free_host,
    start_arguments,
    tcp_of_joints,
)
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

SCRIPT_PORT: Final = 30002
_UPLOAD_S = 1.0
_UPLOADING_NS = 100_000_000
# What the emulated controller recognises ur-rtde's program by.
_PROGRAM: Final = b"def rtde_control():\n  rtde_set_watchdog\nend\n"

UNLOCK_AFTER_S = 0.1
"""A real controller keeps a protective stop locked for 5 s; too long for a test."""


def host_of(address: int) -> str:
    """Return the loopback address of emulator ``address``, below 11 000 000: its ports are fixed, so each needs one."""
    high, low = divmod(address, 250)
    return f"127.{64 + high // 250}.{high % 250}.{low + 1}"


def config_of(address: int) -> UrConfig:
    """Return the configuration with which the fixture's driver finds emulator ``address``.

    Timeouts are long, because test machines are busy: with the defaults, a pause of a tenth of a second is a fault.
    """
    return UrConfig(
        host=host_of(address),
        flange_to_tcp_mm_deg=(0.0, 0.0, 100.0, 0.0, 0.0, 0.0),
        watchdog_hz=5.0,
        state_timeout_s=0.3,
    )


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build the fixture on its own loopback address; it stores nothing in ``folder``."""
    host = host_of(address)

    def start() -> EmulatorProcess:
        return EmulatorProcess("ur", "--host", host, "--unlock-after", str(UNLOCK_AFTER_S)).start()

    def build(clock: Clock) -> Device:
        return SPEC.build("ur", config_of(address), DriverContext(clock))

    return DeviceFixture(
        spec=SPEC,
        start=start,
        build=build,
        config=config_of(address),
        configured=lambda other, clock: SPEC.build("ur", other, DriverContext(clock)),
        time="t_s",
        pose="T_base_tcp",
        faults={
            "drop": (5, "unseen"),
            "corrupt": (5, "transient"),
            "nan": (5, "transient"),
            "out_of_order": (5, "unseen"),
            "delay": (0.5, "fault"),
            "pause": (True, "fault"),
            "unplug": (True, "fault"),
            "restart": (True, "fault"),
            "protective_stop": (True, "fault"),
            "emergency_stop": (True, "fault"),
            "program_stop": (True, "fault"),
            "power_off": (True, "fault"),
        },
        notes=(
            "stopping distance after the controller's watchdog has stopped the program",
            "that speedl's time argument only sets when it returns",
            "that registers keep their values when a program or a client ends",
        ),
    )


def rig_in_step(folder: Path, address: int) -> DeviceFixture:
    """Build the same fixture on a simulated time, which the emulator shares with the driver."""
    world = Lockstep([driver, control, state])
    arguments = ("--host", host_of(address), "--unlock-after", str(UNLOCK_AFTER_S))
    return replace(
        rig(folder, address),
        start=lambda: emulator_in_step(world, "ur", *arguments).start(),
        build=lambda clock: arm_in_step(config_of(address), clock),
        configured=arm_in_step,
        world=world,
        clock=lambda: world,
        reachable=False,
    )


def arm_in_step(config: UrConfig, clock: Clock) -> UrArm:
    """Build the driver with an upload that takes no other process, for an emulator in the same world."""

    def upload(device: str, host: str) -> None:
        try:
            # Claimed and cleared first, as ur-rtde does.
            registers = Registers(device, host, _UPLOAD_S, clock)
            with closing(registers), socket.create_connection((host, SCRIPT_PORT), _UPLOAD_S) as script:
                registers.feed_watchdog()
                script.sendall(_PROGRAM)
                clock.sleep_until_ns(clock.now_ns() + _UPLOADING_NS)
        except (OSError, TransportError, CorruptMessage) as error:
            raise DeviceGone(device, f"upload to {host}: {error}") from None

    return UrArm("ur", config, clock, upload)


def _settings(config: UrConfig, folder: Path, number: int) -> Mapping[str, Any]:
    return {"host": free_host(30004, number)}


def _start(config: UrConfig, start_deg: Sequence[float] | None) -> EmulatorProcess:
    return EmulatorProcess("ur", "--host", config.host, *start_arguments(start_deg))


_FAULTS: Final = {
    # A state that never comes leaves the one before it.
    "stale": ("delay", lambda _: FOR_EVER_S),
    "nan_state": ("nan", lambda _: FOR_EVER_PACKETS),
}

EMULATED = EmulatedDriver("ur", _settings, _start, tcp_of_joints, _FAULTS)
