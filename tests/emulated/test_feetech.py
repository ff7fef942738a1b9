from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.bus_arms import CLOCK, UP, pause, position, running, wait
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.feetech.driver import FeetechSerialArm
from touchcell.drivers.feetech.rig import config, emulator, rig
from touchcell.testing.emulation.process import EmulatorProcess


@pytest.fixture
def port(tmp_path: Path) -> Path:
    return tmp_path / "servos-1"


@pytest.fixture
def servos(port: Path) -> Iterator[EmulatorProcess]:
    yield from running(rig(port.parent, 1))


@pytest.fixture
def arm(port: Path, servos: EmulatorProcess) -> Iterator[FeetechSerialArm]:
    arm = FeetechSerialArm("arm", config(port), CLOCK)
    yield arm
    arm.disconnect()


def stream(arm: FeetechSerialArm, lease: Lease, twist: np.ndarray, seconds: float) -> None:
    until_ns = CLOCK.now_ns() + round(seconds * 1e9)
    while CLOCK.now_ns() < until_ns:
        arm.send_twist(TwistCommand(twist, TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
        pause(0.01)


def test_one_line_has_one_owner(arm: FeetechSerialArm, port: Path) -> None:
    arm.connect()
    with pytest.raises(ConnectError, match="in use elsewhere"):
        FeetechSerialArm("other", config(port), CLOCK).connect()
    assert arm.joints(0.5).seq > 0


def test_an_adapter_that_echoes(tmp_path: Path) -> None:
    port = tmp_path / "echoing"
    with emulator(port, "--echo") as servos:
        with pytest.raises(ConnectError, match="echo: true"):
            FeetechSerialArm("arm", config(port), CLOCK).connect()
        with FeetechSerialArm("arm", config(port, echo=True), CLOCK) as arm:
            arm.configure()
            arm.activate()
            lease = arm.acquire("test")
            start = position(servos.state())
            stream(arm, lease, UP, 0.3)
            wait(arm.at_rest)
            assert position(servos.wait_for(still=True))[2] > start[2] + 5e-3
            counts = arm.health()
            # Echoes are taken away, not counted as damage; a busy machine may delay one.
            assert int(counts["answered"]) > 20 * sum(int(counts[key]) for key in ("corrupt", "unexpected", "late"))


CLIENT = """
import sys, time
from pathlib import Path
import numpy as np
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.feetech.rig import config
from touchcell.drivers.feetech.driver import FeetechSerialArm
clock = MonotonicClock()
arm = FeetechSerialArm("arm", config(Path(sys.argv[1])), clock)
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
def test_a_dead_host_leaves_the_arm_at_its_last_step(port: Path, servos: EmulatorProcess, number: int) -> None:
    client = subprocess.Popen([sys.executable, "-c", CLIENT, str(port)], stdout=subprocess.PIPE)
    try:
        assert client.stdout is not None
        assert client.stdout.readline() == b"moving\n"
        os.kill(client.pid, number)
        killed = position(servos.state())
        stopped = servos.wait_for(still=True)
        # The rest is the servos' own lag (0.03 s at 0.05 m/s) and one step of 0.025 s, besides pending motion.
        assert np.linalg.norm(position(stopped) - killed) < 0.01
        assert np.abs(np.array(stopped["goals"]) - stopped["ticks"]).max() <= 1
        assert stopped["enabled"] == 5
    finally:
        client.kill()
        client.wait()
        client.stdout.close()
