"""Test fixture: the ``feetech_serial`` driver with five emulated servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from touchcell.drivers.feetech import driver as feetech_serial
from touchcell.testing.emulation.in_cell import EmulatedDriver, start_arguments, tcp_of_joints
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

PARK_DEG = (0.0, -60.0, 140.0, 60.0, 0.0)
TOOL = {"origin_mm": [0, 0, 40]}
ZERO_TICKS = (2048, 2100, 1250, 1990, 2048)
DIRECTION = (1, -1, 1, 1, -1)


def config(port: Path, **changes: object) -> feetech_serial.FeetechSerialConfig:
    """Return a configuration of five servos at ``port``, with rates and timeouts for a busy machine."""
    servos = [
        {"id": number, "zero_ticks": zero, "direction": direction}
        for number, (zero, direction) in enumerate(zip(ZERO_TICKS, DIRECTION, strict=True), start=1)
    ]
    settings: dict[str, object] = {
        "port": str(port),
        "servos": servos,
        "tool": TOOL,
        "park_deg": PARK_DEG,
        "rate_hz": 40.0,
        "max_silence_s": 0.4,
    }
    return feetech_serial.FeetechSerialConfig.model_validate(settings | changes)


def emulator(port: Path, *arguments: str) -> EmulatorProcess:
    """Build an emulator of the servos that ``config`` describes; it is not started yet."""
    return EmulatorProcess(
        "feetech",
        *("--link", str(port), "--tool", config(port).tool.model_dump_json()),
        *("--zero-ticks", *map(str, ZERO_TICKS), "--direction", *map(str, DIRECTION)),
        *arguments,
    )


def rig(folder: Path, address: int) -> DeviceFixture:
    """Build one arm on a pseudo-terminal of its own, linked in ``folder``; ``address`` keeps several apart."""
    port = folder / f"servos-{address}"
    return DeviceFixture(
        spec=feetech_serial.SPEC,
        start=lambda: emulator(port).start(),
        build=lambda clock: feetech_serial.FeetechSerialArm("arm", config(port), clock),
        config=config(port),
        configured=lambda other, clock: feetech_serial.FeetechSerialArm("arm", other, clock),
        pose="T_base_tcp",
        reset="reset",
        state_rate_hz=40.0,
        faults={
            "drop": (3, "transient"),
            "corrupt": (3, "transient"),
            "short": (3, "transient"),
            "wild": (3, "transient"),
            "jump": (3, "transient"),
            "foreign": (3, "transient"),
            "out_of_order": (3, "transient"),
            "delay": (0.6, "fault"),
            "pause": (True, "fault"),
            "silent": (2, "fault"),
            "fault_bits": ([1, 0x20], "fault"),
            "restart": (True, "fault"),
            "unplug": (True, "fault"),
        },
        notes=(
            "an overloaded servo reports it until its torque is switched off",
            "a servo that loses power for a moment restarts without torque and with the factory's limits",
            "reading further registers in the same sync read is harmless",
        ),
    )


def _settings(config: feetech_serial.FeetechSerialConfig, folder: Path, number: int) -> Mapping[str, Any]:
    settings: dict[str, Any] = {"port": str(folder / f"servos-{number}"), "echo": False}
    # The emulated servos are numbered from the base.
    return settings | {f"servos.{index}.id": index + 1 for index in range(config.joint_count)}


def _start(config: feetech_serial.FeetechSerialConfig, start_deg: Sequence[float] | None) -> EmulatorProcess:
    return EmulatorProcess(
        "feetech",
        *("--link", config.port, "--chain", str(config.chain), "--tool", config.tool.model_dump_json()),
        *("--zero-ticks", *(str(servo.zero_ticks) for servo in config.servos)),
        *("--direction", *(str(servo.direction) for servo in config.servos)),
        *start_arguments(start_deg),
    )


EMULATED = EmulatedDriver("feetech_serial", _settings, _start, tcp_of_joints)
