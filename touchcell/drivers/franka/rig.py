"""Test fixture: the Franka driver with an emulated controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.franka.driver import SPEC, FrankaArm, FrankaConfig
from touchcell.testing.emulation.in_cell import (
    FOR_EVER_PACKETS,
    FOR_EVER_S,
    EmulatedDriver,
    TcpOfJoints,
    free_host,
    start_arguments,
    tcp_of_joints,
)
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

PATIENCE_S: Final = 0.3
"""A machine that is busy for so long slows the emulated arm down; on a real one it would be a reflex."""


def host_of(address: int) -> str:
    """Return the loopback address of emulator ``address``: libfranka's port is fixed, so each needs its own."""
    return str(IPv4Address("127.96.0.1") + address)


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build an arm at a loopback address of its own; it stores nothing in ``folder``."""
    host = host_of(address)
    # Emulators also run without a real-time kernel.
    config = FrankaConfig(host=host, enforce_realtime=False, state_timeout_s=0.5)

    def start() -> EmulatorProcess:
        return EmulatorProcess("franka", "--host", host, "--patience", str(PATIENCE_S)).start()

    def build(clock: Clock) -> FrankaArm:
        return FrankaArm("arm", config, clock)

    return DeviceFixture(
        spec=SPEC,
        start=start,
        build=build,
        config=config,
        configured=lambda other, clock: FrankaArm("arm", other, clock),
        time="t_s",
        pose="T_base_ee",
        faults={
            "drop_states": (5, "unseen"),
            "out_of_order": (5, "unseen"),
            "nan": (3, "transient"),
            "pause": (True, "fault"),
            "unplug": (True, "fault"),
            "restart": (True, "fault"),
            "reflex": ("cartesian_reflex", "fault"),
            "user_stop": (True, "fault"),
        },
        notes=(
            "reflex thresholds, modes and recovery are as Franka documents them; a real arm brakes, the emulator stops",
            "a truncated state packet is counted while the arm is at rest, but ends a motion: libfranka aborts it",
            "20 lost command packets stop the arm, as Franka documents it",
        ),
    )


def _settings(config: FrankaConfig, folder: Path, number: int) -> Mapping[str, Any]:
    settings: dict[str, Any] = {"host": free_host(1337, number), "enforce_realtime": False}
    if config.flange_to_tcp_mm_deg is None:
        # What is set in Desk is not known here; simulated cells assume the flange too.
        settings["flange_to_tcp_mm_deg"] = [0, 0, 0, 0, 0, 0]
    return settings


def _start(config: FrankaConfig, start_deg: Sequence[float] | None) -> EmulatorProcess:
    return EmulatorProcess("franka", "--host", config.host, *start_arguments(start_deg))


def _tcp(config: FrankaConfig, state: Mapping[str, Any]) -> TcpOfJoints:
    if config.flange_to_tcp_mm_deg is not None:
        return tcp_of_joints(config, state)
    # The end effector is as it is set in Desk.
    chain, F_T_EE = config.described_chain(), np.array(state["F_T_EE"], dtype=np.float64)
    return lambda q: chain.forward(q) @ F_T_EE


_FAULTS: Final = {
    # A state that never comes leaves the one before it.
    "stale": ("delay", lambda _: FOR_EVER_S),
    "nan_state": ("nan", lambda _: FOR_EVER_PACKETS),
}

EMULATED = EmulatedDriver("franka", _settings, _start, _tcp, _FAULTS)
