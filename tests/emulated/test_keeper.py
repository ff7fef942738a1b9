"""A keeper holds the arm of a client that dies, and lowers it slowly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.damiao.driver import DamiaoCanArm, DamiaoCanConfig
from touchcell.drivers.damiao.rig import config
from touchcell.testing.emulation.process import EmulatorProcess

CLIENT = """
import sys, time
from pathlib import Path
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.damiao.driver import DamiaoCanArm
from tests.emulated.test_keeper import kept
arm = DamiaoCanArm("arm", kept(Path(sys.argv[1])), MonotonicClock())
arm.connect()
arm.configure()
arm.activate()
print(arm.health()["keeper_pid"], flush=True)
time.sleep(1000)
"""
HELD_M = 0.02
SPEED_M_S = 0.05
WINDOW_S = 0.5


def kept(channel: Path) -> DamiaoCanConfig:
    """Return the fixture's configuration with a keeper, and rates for a busy machine."""
    return config(channel, keeper=True, rate_hz=50.0, max_missed_fraction=0.98, lower_after_s=0.5)


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    return tmp_path / "can"


def start(channel: Path) -> EmulatorProcess:
    return EmulatorProcess("damiao", str(channel), "--tool", config(channel).tool.model_dump_json()).start()


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_an_arm_whose_client_dies_or_freezes_is_held_and_then_lowered_slowly(channel: Path, end: int) -> None:
    with start(channel) as emulator:
        client = subprocess.Popen([sys.executable, "-c", CLIENT, str(channel)], stdout=subprocess.PIPE, text=True)
        assert client.stdout is not None
        keeper = int(client.stdout.readline())
        try:
            stood = np.array(emulator.state()["position_m"])
            os.kill(client.pid, end)
            ended_s = time.monotonic()
            seen = []
            while time.monotonic() < ended_s + 4.0:
                state = emulator.state()
                seen.append((time.monotonic() - ended_s, *state["position_m"]))
                assert state["enabled"] == 6
            path = np.array(seen)
        finally:
            client.kill()
            client.wait()
            client.stdout.close()
            os.kill(keeper, signal.SIGKILL)
    away_m = np.linalg.norm(path[:, 1:] - stood, axis=1)
    assert away_m[path[:, 0] < 0.5].max() <= HELD_M
    assert away_m[-1] > HELD_M
    later = np.searchsorted(path[:, 0], path[:, 0] + WINDOW_S)
    inside = later < len(path)
    moved_m = np.linalg.norm(path[later[inside], 1:] - path[inside, 1:], axis=1)
    assert (moved_m / (path[later[inside], 0] - path[inside, 0])).max() <= SPEED_M_S


def test_a_client_that_disconnects_ends_its_keeper_and_may_come_back(channel: Path) -> None:
    with start(channel) as emulator:
        for _ in range(2):
            emulator.fault("reset")
            arm = DamiaoCanArm("arm", kept(channel), MonotonicClock())
            arm.connect()
            arm.configure()
            arm.activate()
            assert arm.state is Lifecycle.ACTIVE
            arm.disconnect()


def test_a_second_client_is_refused_while_a_keeper_has_the_bus(channel: Path) -> None:
    with start(channel):
        first = DamiaoCanArm("first", kept(channel), MonotonicClock())
        first.connect()
        with pytest.raises(ConnectError, match="keeper"):
            DamiaoCanArm("second", kept(channel), MonotonicClock()).connect()
        first.disconnect()
