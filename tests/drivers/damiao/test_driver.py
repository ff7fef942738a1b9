"""The Damiao driver beside its emulator, on one simulated time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tests.helpers.bus_arms import CLOCK, TOKEN, UP, activate, faulted, in_step, pause, position, wait
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle
from touchcell.drivers.core.errors import (
    CommandRejected,
    ConnectError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    LifecycleError,
    Rejection,
    Remedy,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.spec import DRIVERS
from touchcell.drivers.damiao.driver import DamiaoCanArm
from touchcell.drivers.damiao.rig import config, rig_in_step
from touchcell.errors import ConfigError
from touchcell.testing.emulation.lockstep import EmulatorInStep


@pytest.fixture(scope="module")
def channel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damiao") / "can-1"


@pytest.fixture(scope="module")
def process(channel: Path) -> Iterator[EmulatorInStep]:
    yield from in_step(rig_in_step(channel.parent, 1))


@pytest.fixture
def emulator(process: EmulatorInStep) -> EmulatorInStep:
    process.fault("reset")
    return process


@pytest.fixture
def arm(channel: Path, emulator: EmulatorInStep) -> Iterator[DamiaoCanArm]:
    arm = DamiaoCanArm("arm", config(channel), CLOCK)
    yield arm
    arm.disconnect()


def stream(arm: DamiaoCanArm, lease: Lease, twist: np.ndarray, seconds: float) -> np.ndarray:
    """Sends the twist for so long; returns the measured ones."""
    measured = []
    until_ns = CLOCK.now_ns() + round(seconds * 1e9)
    while CLOCK.now_ns() < until_ns:
        arm.send_twist(TwistCommand(twist, TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
        measured.append(arm.tcp().value.twist)
        pause(0.01)
    return np.array(measured)


def test_it_is_registered_and_declares_that_it_falls() -> None:
    spec = DRIVERS.load("damiao_can")
    assert spec.capabilities.falls_on_power_loss
    assert not spec.capabilities.has_brakes
    assert not spec.capabilities.hardware_validated


def test_connecting_and_configuring_energise_nothing(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    arm.connect()
    assert emulator.state()["watchdog_s"] == [0.4] * 6
    arm.configure()
    state = emulator.state()
    assert (state["energising"], state["enabled"], state["commands"]) == (0, 0, 0)
    assert state["watchdog_s"] == pytest.approx([0.35] * 6)
    assert arm.watchdog_s() == pytest.approx(0.35)
    np.testing.assert_allclose(arm.tcp(0.5).value.T_base_tcp[:3, 3], state["position_m"], atol=1e-3)


def test_activation_moves_nothing_and_holds(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    start = position(emulator.state())
    activate(arm)
    state = emulator.wait_for(enabled=6)
    commands = state["commands"]
    wait(lambda: emulator.state()["commands"] > commands + 600)
    np.testing.assert_allclose(position(emulator.state()), start, atol=1e-3)
    assert arm.at_rest()
    tau = arm.joints(0.5).value.tau
    assert tau is not None
    # The weight of the arm is carried by feed-forward, so the setpoint and the joints agree.
    assert abs(tau[1]) > 3.0
    np.testing.assert_allclose(arm.joints().value.q, np.array(emulator.state()["target_rad"]), atol=5e-3)


def test_a_twist_moves_the_tool_and_its_expiry_stops_it(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    lease = activate(arm)
    start = position(emulator.state())
    measured = stream(arm, lease, UP, 0.8)
    # A starved loop moves the setpoint more slowly than commanded, never faster.
    speed = np.median(measured, axis=0)
    assert 0.01 < speed[2] < 0.06
    np.testing.assert_allclose(speed[:2], 0.0, atol=0.01)
    # No further command: the last one lives 0.2 s, slowing down takes 0.1 s.
    wait(arm.at_rest)
    emulator.wait_for(still=True)
    stopped = position(emulator.state())
    moved = stopped - start
    assert 0.01 < moved[2] < 0.075
    np.testing.assert_allclose(moved[:2], 0.0, atol=2e-3)
    commands = emulator.state()["commands"]
    wait(lambda: emulator.state()["commands"] > commands + 300)
    np.testing.assert_allclose(position(emulator.state()), stopped, atol=1e-3)
    assert arm.fault is None


def test_stop_needs_no_lease_and_releasing_stops(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    lease = activate(arm)
    stream(arm, lease, UP, 0.3)
    arm.stop()
    wait(arm.at_rest)
    stream(arm, lease, UP, 0.3)
    arm.release(lease)
    wait(arm.at_rest)
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(TwistCommand(UP, TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
    assert caught.value.reason is Rejection.LEASE


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        ("drop", "missed"),
        ("corrupt", "corrupt"),
        ("foreign", "corrupt"),
        ("out_of_order", "missed"),
        ("error_frames", "error_frames"),
    ],
)
def test_a_few_losses_are_counted_and_survived(
    arm: DamiaoCanArm, emulator: EmulatorInStep, fault: str, counter: str
) -> None:
    lease = activate(arm)
    before = int(arm.health()[counter])
    seq = arm.joints().seq
    emulator.fault(fault, 3)
    wait(lambda: int(arm.health()[counter]) >= before + 3)
    wait(lambda: arm.joints().seq > seq + 20)
    stream(arm, lease, UP, 0.1)
    assert arm.state is Lifecycle.ACTIVE
    wait(arm.at_rest)
    np.testing.assert_allclose(arm.joints(0.5).value.q, emulator.state()["q_rad"], atol=0.02)


def test_late_replies_are_not_mistaken_for_fresh_ones(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    activate(arm)
    emulator.fault("delay", 0.05)
    seq = arm.joints().seq
    wait(lambda: arm.joints().seq > seq + 20)
    assert arm.joints().age_s(CLOCK.now_ns()) > 0.049
    with pytest.raises(StaleData):
        arm.tcp(0.03)
    emulator.clear("delay")
    # The queue of requests finds its place again, also after answers and fences were lost.
    emulator.fault("drop", 100)
    emulator.wait_for(faults=[])
    wait(lambda: arm.joints().age_s(CLOCK.now_ns()) < 0.02)


def test_a_silent_motor_is_a_fault_and_the_others_hold(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    lease = activate(arm)
    emulator.fault("silent", 5)
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, TransportTimeout)
    with pytest.raises(StaleData):
        arm.joints(0.1)
    with pytest.raises(CommandRejected):
        arm.send_twist(TwistCommand(UP, TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
    # The silent motor's own timeout has disabled it; the others still receive commands.
    emulator.wait_for(status=[1, 1, 1, 1, 1, 13])
    with pytest.raises(TransportTimeout):
        arm.recover(TOKEN)
    assert faulted(arm)
    emulator.clear("silent")
    wait(lambda: arm.joints().age_s(CLOCK.now_ns()) < 0.1)
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY
    assert emulator.state()["status"] == [1, 1, 1, 1, 1, 0]
    arm.activate()
    assert emulator.state()["enabled"] == 6


@pytest.mark.parametrize(
    ("fault", "value", "code", "fault_class", "needs"),
    [
        ("fault_bits", [1, 0xA], 0xA, FaultClass.OVERLOAD, Remedy.RECOVER),
        ("fault_bits", [0, 0x9], 0x9, FaultClass.ELECTRICAL, Remedy.OPERATOR),
        ("hot", [4, 110], 0xC, FaultClass.THERMAL, Remedy.RECOVER),
    ],
)
def test_a_motor_s_fault_is_decoded_and_only_recovered_on_request(
    arm: DamiaoCanArm,
    emulator: EmulatorInStep,
    fault: str,
    value: list[int],
    code: int,
    fault_class: FaultClass,
    needs: Remedy,
) -> None:
    activate(arm)
    emulator.fault(fault, value)
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceFault)
    assert (arm.fault.vendor_code, arm.fault.fault_class, arm.fault.needs) == (code, fault_class, needs)
    assert f"motor {value[0] + 1}" in arm.fault.name
    with pytest.raises(DeviceFault):
        arm.recover(TOKEN)
    assert faulted(arm)
    emulator.clear(fault)
    if fault == "hot":
        emulator.fault("hot", [4, 40])
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY
    assert arm.fault is None
    assert emulator.state()["status"][value[0]] == 0


def test_pushing_the_arm_off_its_setpoint_is_a_fault_and_it_yields(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    activate(arm)
    emulator.fault("push", [0, 18.0])
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceFault)
    assert arm.fault.fault_class is FaultClass.MOTION
    assert "joint base" in arm.fault.name
    # It holds where it was pushed to instead of pushing back.
    wait(lambda: abs(emulator.state()["target_rad"][0]) > np.deg2rad(7.0))
    assert emulator.state()["enabled"] == 6


def test_a_frozen_bus_is_stale_then_a_fault(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    activate(arm)
    emulator.freeze()
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, TransportTimeout)
    with pytest.raises(StaleData):
        arm.tcp(0.1)
    emulator.thaw()


def test_an_unplugged_adapter_is_lost_until_reconnected(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    activate(arm)
    emulator.fault("unplug")
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceGone)
    # Without the host each motor disables itself by its own timeout.
    emulator.wait_for(status=[13] * 6)
    with pytest.raises(DeviceGone):
        arm.recover(TOKEN)
    arm.disconnect()
    emulator.clear("unplug")
    arm.connect()
    # The motors report that they lost the host: an operator must inspect them before they are used again.
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceFault)
    assert arm.fault.vendor_code == 13
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY


def test_bus_off_is_a_fault_that_shows_in_health(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    activate(arm)
    emulator.fault("bus_off")
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceFault)
    assert arm.fault.vendor_code == "bus-off"
    health = arm.health()
    assert (health["bus_state"], health["bus_error"]) == ("error", "bus-off")
    emulator.clear("bus_off")
    wait(lambda: arm.health()["bus_state"] == "active" and arm.joints().age_s(CLOCK.now_ns()) < 0.1)
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY
    emulator.fault("bus_off")
    wait(lambda: faulted(arm))
    arm.disconnect()
    emulator.fault("reset")
    arm.connect()
    assert arm.state is Lifecycle.PASSIVE
    assert arm.health()["bus_state"] == "active"


def test_motors_that_lost_power_are_noticed(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    arm.connect()
    arm.configure()
    emulator.fault("restart")
    # Their timeout is the factory's again.
    with pytest.raises(DeviceFault) as caught:
        arm.activate()
    assert caught.value.vendor_code == "TIMEOUT"
    assert emulator.state()["energising"] == 0
    arm.disconnect()
    activate(arm)
    emulator.fault("restart")
    wait(lambda: faulted(arm))
    assert "disabled itself" in str(arm.fault)


def test_deactivation_policies(channel: Path, emulator: EmulatorInStep) -> None:
    park_deg = [5.0, 30.0, 100.0, 0.0, 50.0, 5.0]
    with DamiaoCanArm("arm", config(channel, park_deg=park_deg), CLOCK) as arm:
        check_deactivation(arm, emulator, park_deg)


def check_deactivation(arm: DamiaoCanArm, emulator: EmulatorInStep, park_deg: list[float]) -> None:
    arm.configure()
    arm.activate()
    for policy in (DeactivatePolicy.OFF, DeactivatePolicy.BRAKE):
        with pytest.raises(LifecycleError):
            arm.deactivate(policy)
        assert arm.state is Lifecycle.ACTIVE
    arm.deactivate(DeactivatePolicy.HOLD)
    held = emulator.state()
    assert (held["enabled"], arm.state) == (6, Lifecycle.READY)
    commands = held["commands"]
    wait(lambda: emulator.state()["commands"] > commands + 300)
    np.testing.assert_allclose(emulator.state()["q_rad"], held["q_rad"], atol=0.01)
    energising = held["energising"]
    arm.activate()
    assert emulator.state()["energising"] == energising
    arm.deactivate(DeactivatePolicy.PARK_THEN_OFF)
    state = emulator.state()
    assert state["enabled"] == 0
    # The position when it was disabled; from there it sinks.
    np.testing.assert_allclose(np.rad2deg(state["target_rad"]), park_deg, atol=0.1)
    assert arm.state is Lifecycle.READY


def test_it_moves_to_joint_angles_and_refuses_impossible_ones(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    lease = activate(arm)
    goal = np.deg2rad([5.0, 35.0, 95.0, 5.0, 45.0, 10.0])
    arm.go_to_joints(goal, lease, speed_fraction=0.5)
    assert not arm.at_rest()
    wait(arm.at_rest)
    np.testing.assert_allclose(emulator.state()["q_rad"], goal, atol=np.deg2rad(0.5))
    for bad, reason in (
        (np.full(6, np.nan), Rejection.NON_FINITE),
        (np.zeros(5), Rejection.SHAPE),
        (np.full(6, 3.0), Rejection.LIMIT),
    ):
        with pytest.raises(CommandRejected) as caught:
            arm.go_to_joints(bad, lease)
        assert caught.value.reason is reason


def test_non_finite_full_scales_are_refused(channel: Path, emulator: EmulatorInStep) -> None:
    emulator.fault("nan")
    arm = DamiaoCanArm("arm", config(channel), CLOCK)
    with pytest.raises(ConnectError) as caught:
        arm.connect()
    assert len(caught.value.causes) == 6
    assert arm.state is Lifecycle.DISCONNECTED


def test_missing_motors_and_buses_are_named(channel: Path, emulator: EmulatorInStep) -> None:
    emulator.fault("silent", 3)
    arm = DamiaoCanArm("arm", config(channel), CLOCK)
    with pytest.raises(ConnectError, match="motor 4"):
        arm.connect()
    with pytest.raises(ConnectError, match="no hub"):
        DamiaoCanArm("arm", config(channel.parent / "elsewhere"), CLOCK).connect()


def test_direction_and_offset_turn_motor_angles_into_joint_angles(channel: Path, emulator: EmulatorInStep) -> None:
    plain = config(channel)
    motors = [motor.model_dump() for motor in plain.motors]
    motors[1] |= {"direction": -1, "offset_deg": 30.0}
    with DamiaoCanArm("arm", config(channel, motors=motors), CLOCK) as arm:
        q_deg = np.rad2deg(arm.joints().value.q)
    np.testing.assert_allclose(q_deg, [0.0, 30.0 - 40.0, 90.0, 0.0, 50.0, 0.0], atol=0.05)


def test_can_fd_works_as_well(channel: Path, emulator: EmulatorInStep) -> None:
    with DamiaoCanArm("arm", config(channel, fd=True), CLOCK) as arm:
        arm.configure()
        arm.activate()
        assert emulator.state()["enabled"] == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate_hz": 1000.0, "watchdog_s": 0.1}, "load the bus to 162%"),
        ({"watchdog_s": 0.0}, "watchdog_s"),
        ({"rate_hz": 100.0, "watchdog_s": 0.03}, "four cycles"),
        ({"limits": {"tcp_speed_m_s": -0.1}}, "tcp_speed_m_s"),
        ({"limits": {"tcp_speed_m_s": float("nan")}}, "tcp_speed_m_s"),
        ({"park_deg": [0.0]}, "park_deg"),
        ({"park_deg": None, "on_disconnect": "park_then_off"}, "needs park_deg"),
        ({"motors": [{"esc_id": 1, "mst_id": 17}] * 2, "park_deg": None}, "share one esc_id"),
        ({"motors": [{"esc_id": 1, "mst_id": 17, "kp_n_m_rad": 501.0}]}, "kp_n_m_rad"),
        ({"speed": 1}, "speed"),
    ],
)
def test_configurations_that_cannot_be_right_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        config(tmp_path, **changes)


def test_gains_that_would_push_too_hard_are_refused(channel: Path, emulator: EmulatorInStep) -> None:
    arm = DamiaoCanArm("arm", config(channel, tracking_error_deg=40.0), CLOCK)
    with arm, pytest.raises(ConfigError, match="N m before tracking_error_deg trips"):
        arm.configure()


def test_a_park_pose_outside_the_joint_limits_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="joint 'elbow'"):
        config(tmp_path, park_deg=[0.0, 0.0, 155.0, 0.0, 0.0, 0.0]).describe()


def test_another_number_of_motors_than_joints_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has 6 joints"):
        DamiaoCanArm("arm", config(tmp_path, motors=[{"esc_id": 1, "mst_id": 17}], park_deg=None), CLOCK)


def test_a_motor_that_will_not_enable_leaves_none_enabled(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    arm.connect()
    arm.configure()
    emulator.fault("refuse", 3)
    with pytest.raises(DeviceFault, match="motor 4: does not enable"):
        arm.activate()
    assert emulator.state()["enabled"] == 0
    assert arm.state is Lifecycle.READY


def test_a_full_transmit_queue_drops_no_arm(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    activate(arm)
    start = position(emulator.wait_for(enabled=6))
    emulator.fault("tx_full", 12)
    wait(lambda: int(arm.health()["not_sent"]) >= 12)
    commands = emulator.state()["commands"]
    wait(lambda: emulator.state()["commands"] > commands + 300)
    assert arm.state is Lifecycle.ACTIVE
    assert emulator.state()["enabled"] == 6
    np.testing.assert_allclose(position(emulator.state()), start, atol=1e-3)


def test_a_failing_control_loop_keeps_holding_the_arm(
    arm: DamiaoCanArm, emulator: EmulatorInStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    activate(arm)
    start = position(emulator.wait_for(enabled=6))

    def fail(now_ns: int, dt_s: float) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(arm._setpoint, "step", fail)
    wait(lambda: faulted(arm))
    commands = emulator.state()["commands"]
    wait(lambda: emulator.state()["commands"] > commands + 600)
    assert emulator.state()["enabled"] == 6
    np.testing.assert_allclose(position(emulator.state()), start, atol=2e-3)
    monkeypatch.undo()
    sample = arm.joints().seq
    wait(lambda: arm.joints().seq > sample)
    arm.recover(TOKEN)
    arm.activate()
    assert emulator.state()["enabled"] == 6


def test_an_encoder_one_turn_off_is_counted_into_the_joints_range(arm: DamiaoCanArm, emulator: EmulatorInStep) -> None:
    emulator.fault("turn_off", [1, -1])
    activate(arm)
    state = emulator.wait_for(enabled=6)
    np.testing.assert_allclose(arm.joints().value.q, state["q_rad"], atol=5e-3)
    assert arm.health()["turns_added"] == "0 1 0 0 0 0"
    commands = state["commands"]
    wait(lambda: emulator.state()["commands"] > commands + 300)
    np.testing.assert_allclose(position(emulator.state()), position(state), atol=2e-3)


@pytest.mark.parametrize(
    ("index", "register", "value", "says"),
    [(1, 9, 0, "timeout"), (3, 21, 6.0, "PMAX of motor 4 is 6, was 12.5"), (5, 23, 5.0, "TMAX of motor 6")],
)
def test_settings_that_another_host_changes_are_a_fault_though_nothing_is_lost(
    arm: DamiaoCanArm, emulator: EmulatorInStep, index: int, register: int, value: float, says: str
) -> None:
    activate(arm)
    emulator.fault("registers", [index, register, value])
    wait(lambda: faulted(arm), 2.0)
    assert says in str(arm.fault)
    # What it measures and commands is in the new scale at once.
    pause(0.5)
    np.testing.assert_allclose(arm.joints(0.1).value.q, emulator.state()["q_rad"], atol=0.02)
