"""An emulated Franka and the driver at an address of their own, for the tests of the driver and of the emulator."""

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
from touchcell.testing.emulation.process import EmulatorProcess

OPERATOR = OperatorToken("tester", 0)
DEADLINE_S = 20.0
_numbers = itertools.count(1)


def fresh_host() -> str:
    """A loopback address that no other test of this machine uses now."""
    return str(IPv4Address("127.16.0.0") + (os.getpid() % 8192) * 512 + next(_numbers))


def eventually(true: Callable[[], bool]) -> None:
    """Wait until ``true()``; fails after the deadline."""
    deadline = time.monotonic() + DEADLINE_S
    while not true():
        assert time.monotonic() < deadline, "it never became true"
        time.sleep(0.002)


class Bench:
    """One emulator, one driver, and what a task would do with them."""

    def __init__(self, **config: Any) -> None:
        host = fresh_host()
        self.clock = MonotonicClock()
        self.emulator = EmulatorProcess("franka", "--host", host, timeout_s=DEADLINE_S).start()
        self.config = FrankaConfig.model_validate({"host": host, "enforce_realtime": False} | config)
        self.arm = self.another()

    def another(self) -> FrankaArm:
        """One more driver for the same arm."""
        return FrankaArm("arm", self.config, self.clock)

    def ready(self) -> FrankaArm:
        """Connected and configured."""
        self.arm.connect()
        self.arm.configure()
        return self.arm

    def active(self) -> Lease:
        """Active, with the lease in hand."""
        self.ready().activate()
        return self.arm.acquire("test")

    def send(
        self, twist: Any, lease: Lease, ttl_s: float = 0.2, frame: TwistFrame = TwistFrame.BASE
    ) -> Sent[TwistCommand]:
        """One twist, computed now."""
        command = TwistCommand(np.asarray(twist, dtype=np.float64), frame, self.clock.now_ns(), ttl_s)
        return self.arm.send_twist(command, lease)

    def truth(self) -> dict[str, Any]:
        """What is true inside the emulator."""
        return self.emulator.state()

    def position(self) -> np.ndarray[Any, Any]:
        """Where the tool centre point truly is."""
        return np.array(self.truth()["position_m"])

    def moved(self) -> None:
        """Wait until it truly moves."""
        self.emulator.wait_for(moving=True)

    def rested(self) -> None:
        """Wait until the driver says that it is at rest."""
        eventually(self.arm.at_rest)

    def close(self) -> None:
        """Disconnect and end the emulator; an arm that has gone cannot confirm that it rests."""
        try:
            with suppress(DeviceError):
                self.arm.disconnect()
        finally:
            self.emulator.stop()
