"""Test fixture: the ``feetech_serial`` driver with five emulated servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from touchcell.drivers.core import bus_arm
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.feetech import bus
from touchcell.drivers.feetech import driver as feetech_serial
from touchcell.drivers.feetech import emulator as feetech_emulator
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.in_cell import EmulatedDriver, start_arguments, tcp_of_joints
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture
from touchcell.testing.emulation.serial_line import SocketLine, SocketPort

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
    return EmulatorProcess("feetech", *_arguments(port), *arguments)


def arm_in_step(
    port: Path, clock: Clock, settings: feetech_serial.FeetechSerialConfig | None = None
) -> feetech_serial.FeetechSerialArm:
    """Build the driver on the socket that an emulator of ``rig_in_step`` has at ``port``."""
    settings = settings or config(port)
    return feetech_serial.FeetechSerialArm("arm", settings, clock, partial(_open_socket, settings))


def rig_in_step(folder: Path, address: int) -> DeviceFixture:
    """Build the same arm as ``rig`` on a simulated time, which the emulator shares with the driver."""
    port = folder / f"servos-{address}"
    world = Lockstep([bus_arm, bus])
    return replace(
        rig(folder, address),
        start=lambda: emulator_in_step(world, "feetech", *_arguments(port), build=_build_on_socket).start(),
        build=lambda clock: arm_in_step(port, clock),
        configured=lambda other, clock: arm_in_step(port, clock, other),
        world=world,
        clock=lambda: world,
        reachable=False,
    )


def _arguments(port: Path) -> tuple[str, ...]:
    return (
        *("--link", str(port), "--tool", config(port).tool.model_dump_json()),
        *("--zero-ticks", *map(str, ZERO_TICKS), "--direction", *map(str, DIRECTION)),
    )


def _build_on_socket(arguments: Any) -> Emulator:
    return feetech_emulator.build_on(SocketLine(arguments.link, config(arguments.link).baudrate), arguments)


def _open_socket(settings: feetech_serial.FeetechSerialConfig) -> SocketPort:
    try:
        return SocketPort(settings.port)
    except OSError as error:
        raise ConnectError("arm", f"cannot open {settings.port}: {error}") from None


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
