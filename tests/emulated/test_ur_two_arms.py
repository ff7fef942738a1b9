"""Two UR arms in one process: what happens to one must not stop the other."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.ur.driver import UrArm
from touchcell.drivers.ur.rig import config_of, host_of
from touchcell.testing.emulation.process import EmulatorProcess

pytest.importorskip("rtde_control", reason="pip install touchcell[ur]")

ADDRESSES = itertools.count(8_000_000 + os.getpid() % 20_000 * 100)
CLOCK = MonotonicClock()
DEADLINE_S = 10.0


class Streaming:
    """Keeps an arm moving from a thread of its own, as a run does, and notes the longest gap between two twists."""

    def __init__(self, arm: UrArm) -> None:
        self.error: Exception | None = None
        self.sent = 0
        self._arm = arm
        self._lease = arm.acquire("test")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._ended.wait(0.01):
            twist = TwistCommand(np.array([0.0, 0.0, 0.001, 0.0, 0.0, 0.0]), TwistFrame.BASE, CLOCK.now_ns(), 0.5)
            try:
                self._arm.send_twist(twist, self._lease)
                self.sent += 1
            except DeviceError as error:
                self.error = error
                return

    def __enter__(self) -> Streaming:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def disconnect(arm: UrArm, emulator: EmulatorProcess) -> None:
    arm.disconnect()


def replug(arm: UrArm, emulator: EmulatorProcess) -> None:
    emulator.fault("unplug")
    deadline_s = time.monotonic() + DEADLINE_S
    while arm.state is not Lifecycle.FAULTED:
        assert time.monotonic() < deadline_s
    emulator.clear("unplug")
    while arm.state is Lifecycle.FAULTED:
        assert time.monotonic() < deadline_s
        try:
            arm.recover(OperatorToken("test", 0))
        except DeviceError:
            continue


@pytest.fixture
def pair() -> Iterator[list[tuple[UrArm, EmulatorProcess]]]:
    """Two activated arms."""
    made = []
    for _ in range(2):
        address = next(ADDRESSES)
        process = EmulatorProcess("ur", "--host", host_of(address), "--unlock-after", "0.1").start()
        made.append((UrArm("ur", config_of(address), CLOCK), process))
    for arm, _ in made:
        arm.connect()
        arm.configure()
        arm.activate()
    yield made
    for arm, process in made:
        arm.disconnect()
        process.stop()


@pytest.mark.parametrize("event", [disconnect, replug])
def test_the_other_arm_moves_on(
    event: Callable[[UrArm, EmulatorProcess], None], pair: list[tuple[UrArm, EmulatorProcess]]
) -> None:
    (moving, its_emulator), (other, other_emulator) = pair
    trips = its_emulator.state()["watchdog_trips"]
    with Streaming(moving) as stream:
        event(other, other_emulator)
        sent = stream.sent
        deadline_s = time.monotonic() + DEADLINE_S
        while stream.sent < sent + 20 and stream.error is None:
            assert time.monotonic() < deadline_s
    assert stream.error is None
    assert moving.state is Lifecycle.ACTIVE
    assert its_emulator.state()["watchdog_trips"] == trips
