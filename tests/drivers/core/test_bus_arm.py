from __future__ import annotations

import threading

import numpy as np
import pytest

from touchcell.drivers.core.bus_arm import BusArm, BusArmConfig
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceFault, DeviceGone, TransportTimeout
from touchcell.drivers.core.samples import JointState, Stamped
from touchcell.drivers.kinematics.chain import ChainFile

DT_S = 0.01


class Config(BusArmConfig):
    chain: ChainFile = "generic_6r"
    rate_hz: float = 100.0

    @property
    def joint_count(self) -> int:
        return 6


class ScriptedArm(BusArm):
    """An arm whose cycles succeed or raise what ``failure`` holds; it counts the commands that it repeats."""

    def __init__(self, clock: VirtualClock) -> None:
        config = Config()
        super().__init__("arm", config, clock, config.described_chain())
        self.failure: Exception | None = None
        self.cycles = 0
        self.repeated = 0

    def _open(self) -> None:
        self._joints = Stamped(JointState(np.zeros(6), np.zeros(6)), self._clock.now_ns(), 1)

    def _open_bus(self) -> None: ...

    def _close_bus(self) -> None: ...

    def _switch_off(self) -> None: ...

    def _reopen_bus(self) -> None: ...

    def _cycle(self, now_ns: int, dt_s: float, until_ns: int) -> None:
        self.cycles += 1
        if self.failure is not None:
            raise self.failure

    def _repeat_commands(self) -> None:
        self.repeated += 1

    def _recover(self, token: OperatorToken) -> None:
        self._thread = threading.current_thread()
        self._require_loop()
        self._latched_fault = None

    def turn(self) -> None:
        now_ns = self._clock.now_ns()
        self._run_cycle(now_ns, DT_S, now_ns + 1)


@pytest.fixture
def arm() -> ScriptedArm:
    arm = ScriptedArm(VirtualClock())
    arm.connect()
    arm.configure()
    arm.activate()
    return arm


@pytest.mark.parametrize(
    "failure", [ValueError("unforeseen"), FloatingPointError("nan"), TransportTimeout("arm", "reply", 0.1)], ids=repr
)
def test_a_cycle_that_fails_is_a_fault_and_the_motors_keep_their_last_commands(
    arm: ScriptedArm, failure: Exception
) -> None:
    arm.failure = failure
    arm.turn()
    arm.turn()
    assert arm.state is Lifecycle.FAULTED
    assert arm.cycles == arm.repeated == 2


def test_a_second_failure_while_repeating_commands_ends_nothing(arm: ScriptedArm) -> None:
    def fail() -> None:
        raise OSError("the adapter fails too")

    arm.failure = ValueError("unforeseen")
    arm._repeat_commands = fail  # type: ignore[method-assign]
    arm.turn()
    arm.turn()
    assert arm.cycles == 2
    assert isinstance(arm.fault, DeviceFault)


def test_a_bus_that_returns_can_be_recovered_without_reconnecting(arm: ScriptedArm) -> None:
    arm.failure = DeviceGone("arm", "interface is down")
    arm.turn()
    assert arm.state is Lifecycle.FAULTED
    with pytest.raises(TransportTimeout):
        arm.recover(OperatorToken("test", 0))
    arm.failure = None
    arm.turn()
    arm.recover(OperatorToken("test", 0))
    assert arm.state is Lifecycle.READY
