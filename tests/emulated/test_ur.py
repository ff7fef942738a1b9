"""The UR driver with ur-rtde's own program, and its death, beside an emulated controller in real time."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.bus_arms import CLOCK, running, wait
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import DeviceFault, TransportTimeout
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.driver import UrArm
from touchcell.drivers.ur.rig import config_of, host_of, rig
from touchcell.testing.emulation.process import EmulatorProcess

pytest.importorskip("rtde_control", reason="pip install touchcell[ur]")

ADDRESSES = itertools.count(os.getpid() % 40_000 * 100)
WATCHDOG_S = 1.0 / config_of(0).watchdog_hz


@pytest.fixture
def address() -> int:
    """An address that no other test uses."""
    return next(ADDRESSES)


@pytest.fixture
def emulator(address: int, tmp_path: Path) -> Iterator[EmulatorProcess]:
    """A fresh emulated controller."""
    yield from running(rig(tmp_path, address))


def test_the_vendors_program_is_uploaded_and_watched(emulator: EmulatorProcess, address: int) -> None:
    with UrArm("ur", config_of(address), CLOCK) as arm:
        arm.configure()
        arm.activate()
        state = emulator.state()
        assert state["watchdog_trips"] == 1
        assert state["watchdog_hz"] == pytest.approx(1.0 / WATCHDOG_S)
        np.testing.assert_allclose(arm.tcp().value.T_base_tcp, state["T_base_tcp"], atol=1e-9)


def test_a_command_left_in_the_registers_does_not_move_the_new_program(emulator: EmulatorProcess, address: int) -> None:
    names = ("input_int_register_0", *(f"input_double_register_{i}" for i in range(8)))
    with socket.create_connection((host_of(address), ur_codec.PORT)) as wire:
        wire.sendall(ur_codec.encode(ur_codec.setup_inputs(names)))
        packets, _ = ur_codec.split(wire.recv(4096))
        recipe = ur_codec.parse_recipe_answer(packets[0].payload, names)
        speed_l: dict[str, ur_codec.Value] = dict.fromkeys(names, 0.05) | {"input_int_register_0": 10}
        wire.sendall(ur_codec.encode(ur_codec.Packet(ur_codec.PacketType.DATA, recipe.pack(speed_l))))
        wait(lambda: emulator.state()["commands"].get("speedL") == 1)
    wait(lambda: emulator.state()["clients"] == 0)
    with UrArm("ur", config_of(address), CLOCK) as arm:
        arm.configure()
        arm.activate()
        assert emulator.state()["travel_m"] == 0.0


def test_the_watchdog_stops_the_arm_while_the_interpreter_is_held(emulator: EmulatorProcess, address: int) -> None:
    down = np.array([0, 0, -0.05, 0, 0, 0])
    with UrArm("ur", config_of(address), CLOCK) as arm:
        arm.configure()
        arm.activate()
        lease = arm.acquire("test")

        def moves() -> bool:
            arm.send_twist(TwistCommand(down, TwistFrame.BASE, CLOCK.now_ns(), 1.0), lease)
            return bool(emulator.state()["speed_m_s"] > 0.048)

        wait(moves)
        while emulator.state()["watchdog_trips"] < 2:
            # One call into C that never lets another Python thread run.
            sum(range(20_000_000))
        state = emulator.wait_for(moving=False)
        assert state["travel_since_command_m"] < 0.05 * (WATCHDOG_S + 0.01) + 0.001
        wait(lambda: arm.state is Lifecycle.FAULTED)
        assert isinstance(arm.fault, DeviceFault | TransportTimeout)


CLIENT = """
import sys, numpy as np
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.ur.rig import config_of
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import DeviceFault, TransportTimeout
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.driver import UrArm
clock = MonotonicClock()
arm = UrArm("ur", config_of(int(sys.argv[1])), clock)
arm.connect(); arm.configure(); arm.activate()
lease = arm.acquire("child")
while True:
    arm.send_twist(TwistCommand(np.array([0, 0, -0.05, 0, 0, 0]), TwistFrame.BASE, clock.now_ns(), 1.0), lease)
    clock.sleep_until_ns(clock.now_ns() + 20_000_000)
"""


def test_the_arm_stops_when_its_client_is_killed(emulator: EmulatorProcess, address: int) -> None:
    client = subprocess.Popen([sys.executable, "-c", CLIENT, str(address)])
    try:
        wait(lambda: emulator.state()["speed_m_s"] > 0.049)
    finally:
        client.kill()
        client.wait()
    state = emulator.wait_for(moving=False)
    assert state["runtime_state"] == "STOPPED"
    assert state["watchdog_trips"] == 2
    after_m = state["travel_since_command_m"]
    assert after_m < 0.05 * (WATCHDOG_S + 0.01) + 0.001, (
        f"{after_m * 1e3:.2f} mm after the last command of a killed client"
    )
