"""Common parts of the emulated tests of motor-bus arms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import wait_readable
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.testing.emulation.lockstep import EmulatorInStep
from touchcell.testing.emulation.process import EmulatorProcess
from touchcell.testing.emulation.rig import DeviceFixture


class WorldClock:
    """Clock of the world in which it is read: the simulated time of a ``Lockstep`` one, else the machine's."""

    def now_ns(self) -> int:
        """Return the time in ns."""
        return emulated_clock().now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until ``t_ns``."""
        emulated_clock().sleep_until_ns(t_ns)

    def wait_readable(self, fd: int, until_ns: int) -> bool:
        """Wait until ``fd`` can be read or ``until_ns``; return whether it can."""
        return wait_readable(emulated_clock(), fd, until_ns)


CLOCK = WorldClock()
TOKEN = OperatorToken("test", 0)
UP = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])


def running(fixture: DeviceFixture) -> Iterator[EmulatorProcess]:
    """Start the emulator of ``fixture``, and stop it when the generator is resumed."""
    assert fixture.start is not None
    process = fixture.start()
    assert isinstance(process, EmulatorProcess)
    yield process
    process.stop()


def in_step(fixture: DeviceFixture) -> Iterator[EmulatorInStep]:
    """Enter the world of ``fixture`` and start its emulator; end both when the generator is resumed."""
    assert fixture.start is not None
    with fixture.world:
        emulator = fixture.start()
        assert isinstance(emulator, EmulatorInStep)
        yield emulator
        emulator.stop()


def pause(seconds: float) -> None:
    """Sleep on the clock."""
    CLOCK.sleep_until_ns(CLOCK.now_ns() + round(seconds * 1e9))


def wait(condition: Callable[[], Any], timeout_s: float = 20.0) -> None:
    """Wait until ``condition()`` is true; fail after the deadline."""
    deadline_ns = CLOCK.now_ns() + round(timeout_s * 1e9)
    while not condition():
        assert CLOCK.now_ns() < deadline_ns, "timeout"
        pause(0.005)


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
