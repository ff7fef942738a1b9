"""An emulated Franka and its driver at a unique address, for the tests of the driver and of the emulator."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable
from contextlib import suppress
from ipaddress import IPv4Address
from typing import Any

import numpy as np

from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import OperatorToken
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.franka.driver import FrankaArm, FrankaConfig
from touchcell.drivers.franka.rig import PATIENCE_S
from touchcell.testing.emulation.process import EmulatorProcess

OPERATOR = OperatorToken("tester", 0)
DEADLINE_S = 20.0
_numbers = itertools.count(1)


def fresh_host() -> str:
    """Return a loopback address that no other test on this machine uses."""
    return str(IPv4Address("127.16.0.0") + (os.getpid() % 8192) * 512 + next(_numbers))


def eventually(true: Callable[[], bool]) -> None:
    """Wait until ``true()``; fail after the deadline."""
    deadline = time.monotonic() + DEADLINE_S
    while not true():
        assert time.monotonic() < deadline, "the condition never became true"
        time.sleep(0.002)


class FrankaHarness:
    """One emulator, one driver, and the calls of a task."""

    def __init__(self, **config: Any) -> None:
        host = fresh_host()
        self.clock = MonotonicClock()
        self.emulator = EmulatorProcess(
            "franka", "--host", host, "--patience", str(PATIENCE_S), timeout_s=DEADLINE_S
        ).start()
        self.config = FrankaConfig.model_validate(
            {"host": host, "enforce_realtime": False, "state_timeout_s": 0.5} | config
        )
        self.arm = self.another()

    def another(self) -> FrankaArm:
        """Return one more driver for the same arm."""
        return FrankaArm("arm", self.config, self.clock)

    def ready(self) -> FrankaArm:
        """Connect and configure the arm."""
        self.arm.connect()
        self.arm.configure()
        return self.arm

    def active(self) -> Lease:
        """Activate the arm and acquire the lease."""
        self.ready().activate()
        return self.arm.acquire("test")

    def send(
        self, twist: Any, lease: Lease, ttl_s: float = 0.2, frame: TwistFrame = TwistFrame.BASE
    ) -> Sent[TwistCommand]:
        """Send one twist, computed now."""
        command = TwistCommand(np.asarray(twist, dtype=np.float64), frame, self.clock.now_ns(), ttl_s)
        return self.arm.send_twist(command, lease)

    def send_at_speed(
        self, twist: Any, lease: Lease, ttl_s: float = 0.2, frame: TwistFrame = TwistFrame.BASE
    ) -> Sent[TwistCommand]:
        """Send one twist that may have its full speed at once: a zero twist has been in force before it."""
        self.send(np.zeros(6), lease, 0.5)
        self.clock.sleep_until_ns(self.clock.now_ns() + 150_000_000)
        return self.send(twist, lease, ttl_s, frame)

    def truth(self) -> dict[str, Any]:
        """Return the ground truth of the emulator."""
        return self.emulator.state()

    def position(self) -> np.ndarray[Any, Any]:
        """Return the true position of the tool centre point."""
        return np.array(self.truth()["position_m"])

    def moved(self) -> None:
        """Wait until it truly moves."""
        self.emulator.wait_for(moving=True)

    def rested(self) -> None:
        """Wait until the driver reports rest."""
        eventually(self.arm.at_rest)

    def close(self) -> None:
        """Disconnect and end the emulator; a disconnected arm cannot confirm that it is at rest."""
        try:
            with suppress(DeviceError):
                self.arm.disconnect()
        finally:
            self.emulator.stop()
