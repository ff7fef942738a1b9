from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.bus_arms import position, running, wait
from touchcell.drivers.damiao.rig import rig
from touchcell.testing.emulation.process import EmulatorProcess


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    return tmp_path / "can-1"


@pytest.fixture
def emulator(channel: Path) -> Iterator[EmulatorProcess]:
    yield from running(rig(channel.parent, 1))


CLIENT = """
import sys, time
from pathlib import Path
import numpy as np
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.damiao.driver import DamiaoCanArm
from touchcell.drivers.damiao.rig import config
clock = MonotonicClock()
arm = DamiaoCanArm("arm", config(Path(sys.argv[1])), clock)
arm.connect(); arm.configure(); arm.activate()
lease = arm.acquire("client")
twist = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
for k in range(10000):
    if arm.fault:
        raise arm.fault
    arm.send_twist(TwistCommand(twist, TwistFrame.BASE, clock.now_ns(), 0.2), lease)
    if k == 50:
        print("moving", flush=True)
    time.sleep(0.01)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_after_a_dead_host_the_arm_stops_and_its_motors_disable_themselves(
    channel: Path, emulator: EmulatorProcess, number: int
) -> None:
    client = subprocess.Popen([sys.executable, "-c", CLIENT, str(channel)], stdout=subprocess.PIPE)
    try:
        assert client.stdout is not None
        assert client.stdout.readline() == b"moving\n"
        os.kill(client.pid, number)
        killed = position(emulator.state())
        state = emulator.wait_for(status=[13] * 6)
        # Until the timeout the motors hold their last position; its velocity term adds kd v / kp.
        assert np.linalg.norm(np.array(state["let_go_position_m"]) - killed) < 0.01
        assert state["last_command_age_s"] >= 0.35
        # Then nothing carries the arm: it has no brakes.
        wait(lambda: position(emulator.state())[2] < killed[2] - 0.01)
    finally:
        client.kill()
        client.wait()
        client.stdout.close()
