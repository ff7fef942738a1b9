"""Test fixture: the ``ur`` driver with an emulated controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.spec import DriverContext
from touchcell.drivers.ur.driver import SPEC, UrConfig
from touchcell.testing.emulation.in_cell import (
    FOR_EVER_PACKETS,
    FOR_EVER_S,
    EmulatedDriver,
    free_host,
    start_arguments,
    tcp_of_joints,
)
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

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
