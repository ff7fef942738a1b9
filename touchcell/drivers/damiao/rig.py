"""Test fixture: the ``damiao_can`` driver with six emulated motors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from touchcell.drivers.core import bus_arm
from touchcell.drivers.damiao import driver as damiao_can
from touchcell.testing.emulation.in_cell import EmulatedDriver, start_arguments, tcp_of_joints
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture, Emulated

PARK_DEG = (0.0, -60.0, 130.0, 0.0, 20.0, 0.0)
TOOL = {"origin_mm": [0, 0, 80], "mass_kg": 0.15, "com_mm": [0, 0, 40]}


def config(channel: Path, **changes: object) -> damiao_can.DamiaoCanConfig:
    """Return a configuration of six motors on the hub at ``channel``, with rates and timeouts for a busy machine."""
    stiff = [90.0, 90.0, 90.0, 40.0, 40.0, 30.0]
    motors = [
        {"esc_id": i + 1, "mst_id": i + 0x11, "kp_n_m_rad": kp, "kd_n_m_s_rad": 3.0 if i < 3 else 1.5}
        for i, kp in enumerate(stiff)
    ]
    settings: dict[str, object] = {
        "interface": "touchcell_hub",
        "channel": str(channel),
        "motors": motors,
        "tool": TOOL,
        "park_deg": PARK_DEG,
        "rate_hz": 125.0,
        "watchdog_s": 0.35,
        "max_silence_s": 0.5,
        "max_missed_fraction": 0.9,
    }
    return damiao_can.DamiaoCanConfig.model_validate(settings | changes)


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build one arm on a hub of its own in ``folder``; ``address`` keeps several apart."""
    channel = folder / f"can-{address}"

    return _fixture(channel, lambda: EmulatorProcess("damiao", *_arguments(channel)).start())


def rig_in_step(folder: Path, address: int) -> DeviceFixture:
    """Build the same arm on a simulated time, which the emulator shares with the driver."""
    channel = folder / f"can-{address}"
    world = Lockstep([bus_arm])
    fixture = _fixture(channel, lambda: emulator_in_step(world, "damiao", *_arguments(channel)).start())
    return replace(fixture, world=world, clock=lambda: world, reachable=False)


def _arguments(channel: Path) -> tuple[str, ...]:
    return str(channel), "--tool", config(channel).tool.model_dump_json()


def _fixture(channel: Path, start: Callable[[], Emulated]) -> DeviceFixture:
    return DeviceFixture(
        spec=damiao_can.SPEC,
        start=start,
        build=lambda clock: damiao_can.DamiaoCanArm("arm", config(channel), clock),
        config=config(channel),
        configured=lambda other, clock: damiao_can.DamiaoCanArm("arm", other, clock),
        state_rate_hz=125.0,
        pose="T_base_tcp",
        reset="reset",
        faults={
            "drop": (3, "transient"),
            "corrupt": (3, "transient"),
            "foreign": (3, "transient"),
            "out_of_order": (3, "transient"),
            "error_frames": (3, "transient"),
            "tx_full": (20, "transient"),
            "delay": (1.0, "fault"),
            "pause": (True, "fault"),
            "silent": (2, "fault"),
            "fault_bits": ([1, 0xA], "fault"),
            "hot": ([4, 110], "fault"),
            "bus_off": (True, "fault"),
            "restart": (True, "fault"),
            "unplug": (True, "fault"),
        },
        notes=(
            "a motor that loses communication disables itself; that its windings then brake is not assumed",
            "any frame to a motor, also a request for its state, feeds its timeout",
            "registers can be read while a motor is enabled",
        ),
    )


def _settings(config: damiao_can.DamiaoCanConfig, folder: Path, number: int) -> Mapping[str, Any]:
    settings: dict[str, Any] = {
        "interface": "touchcell_hub",
        "channel": str(folder / f"can-{number}"),
        "bus_options": {},
    }
    for index in range(config.joint_count):
        # The emulated motors are mounted straight and have ids of their own.
        motor = {"esc_id": index + 1, "mst_id": index + 0x11, "direction": 1, "offset_deg": 0.0}
        settings |= {f"motors.{index}.{key}": value for key, value in motor.items()}
    return settings


def _start(config: damiao_can.DamiaoCanConfig, start_deg: Sequence[float] | None) -> EmulatorProcess:
    tool = config.tool.model_dump_json()
    return EmulatorProcess(
        "damiao", config.channel, "--chain", str(config.chain), "--tool", tool, *start_arguments(start_deg)
    )


EMULATED = EmulatedDriver("damiao_can", _settings, _start, tcp_of_joints)
