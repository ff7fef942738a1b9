"""Common parts of the emulated tests of motor-bus arms."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.lease import Lease
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture

CLOCK = MonotonicClock()
TOKEN = OperatorToken("test", 0)
UP = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])


def running(fixture: DeviceFixture) -> Iterator[EmulatorProcess]:
    """Start the emulator of ``fixture``, and stop it when the generator is resumed."""
    assert fixture.start is not None
    process = fixture.start()
    assert isinstance(process, EmulatorProcess)
    yield process
    process.stop()


def wait(condition: Callable[[], Any], timeout_s: float = 20.0) -> None:
    """Wait until ``condition()`` is true; fail after the deadline."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "timeout"
        time.sleep(0.005)


def activate(arm: Arm) -> Lease:
    """Connect, configure and activate ``arm``; return its lease."""
    arm.connect()
    arm.configure()
    arm.activate()
    return arm.acquire("test")


def position(state: dict[str, Any]) -> np.ndarray:
    """Return the true tool position (3,) m in an emulator's state."""
    return np.array(state["position_m"])


def faulted(arm: Arm) -> bool:
    """Return whether ``arm`` is FAULTED."""
    return arm.state is Lifecycle.FAULTED
