"""The Feetech driver beside its emulator, on one simulated time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tests.helpers.bus_arms import CLOCK, TOKEN, UP, activate, faulted, in_step, pause, position, wait
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
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
from touchcell.drivers.core.samples import Quality
from touchcell.drivers.core.spec import DRIVERS
from touchcell.drivers.feetech.driver import FeetechSerialArm
from touchcell.drivers.feetech.rig import DIRECTION, PARK_DEG, ZERO_TICKS, arm_in_step, config, rig_in_step
from touchcell.errors import ConfigError
from touchcell.testing.emulation.lockstep import EmulatorInStep

TICK_RAD = 2 * np.pi / 4096


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("feetech") / "servos-1"


@pytest.fixture(scope="module")
def process(port: Path) -> Iterator[EmulatorInStep]:
    yield from in_step(rig_in_step(port.parent, 1))


@pytest.fixture
def servos(process: EmulatorInStep) -> EmulatorInStep:
    process.fault("reset")
    return process


@pytest.fixture
def arm(port: Path, servos: EmulatorInStep) -> Iterator[FeetechSerialArm]:
    arm = arm_in_step(port, CLOCK, config(port))
    yield arm
    arm.disconnect()


def send(arm: FeetechSerialArm, lease: Lease, twist: np.ndarray) -> Sent[TwistCommand]:
    return arm.send_twist(TwistCommand(twist, TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)


def stream(arm: FeetechSerialArm, lease: Lease, twist: np.ndarray, seconds: float) -> None:
    until_ns = CLOCK.now_ns() + round(seconds * 1e9)
    while CLOCK.now_ns() < until_ns:
        send(arm, lease, twist)
        pause(0.01)


def test_it_is_registered_and_declares_its_limitations() -> None:
    capabilities = DRIVERS.load("feetech_serial").capabilities
    assert capabilities.falls_on_power_loss
    assert not capabilities.has_brakes
    assert capabilities.max_watchdog_s is None
    assert capabilities.twist_axes == (True, True, True, False, False, True)
    assert not capabilities.hardware_validated


def test_connecting_and_configuring_energise_nothing(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    arm.connect()
    assert servos.state()["log"] == []
    arm.configure()
    state = servos.state()
    assert (state["energising"], state["enabled"], state["commands"]) == (0, 0, 0)
    # 60 % torque; nothing else is changed.
    assert state["log"] == [f"{servo}:48=5802" for servo in range(1, 6)]
    np.testing.assert_allclose(arm.tcp(0.5).value.T_base_tcp[:3, 3], state["position_m"], atol=5e-4)


def test_angles_are_those_of_the_calibration(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    arm.connect()
    state = servos.state()
    by_hand = np.array(DIRECTION) * (np.array(state["ticks"]) - np.array(ZERO_TICKS)) * 360 / 4096
    np.testing.assert_allclose(np.rad2deg(arm.joints(0.5).value.q), by_hand, atol=1e-9)
    np.testing.assert_allclose(arm.joints(0.5).value.q, state["q_rad"], atol=TICK_RAD)


def test_torque_is_enabled_last_with_the_goal_at_the_measured_position(
    arm: FeetechSerialArm, servos: EmulatorInStep
) -> None:
    start = servos.state()
    arm.connect()
    arm.configure()
    settings = len(servos.state()["log"])
    arm.activate()
    state = servos.state()
    log = state["log"][settings : settings + 10]
    assert [entry[:4] for entry in log[:5]] == [f"{servo}:42" for servo in range(1, 6)]
    assert log[5:] == [f"{servo}:40=01" for servo in range(1, 6)]
    assert state["goals"] == start["ticks"]
    np.testing.assert_allclose(position(state), position(start), atol=5e-4)


def test_a_twist_moves_the_tool_and_its_expiry_stops_it(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    start = position(servos.state())
    stream(arm, lease, UP, 0.8)
    np.testing.assert_allclose(arm.tcp(0.5).value.twist[:3], UP[:3], atol=0.02)
    # No further command: the last one lives 0.2 s, slowing down takes 0.1 s.
    wait(arm.at_rest)
    state = servos.wait_for(still=True)
    moved = position(state) - start
    assert 0.03 < moved[2] < 0.075
    np.testing.assert_allclose(moved[:2], 0.0, atol=1.5e-3)
    goals, commands = state["goals"], state["commands"]
    wait(lambda: servos.state()["commands"] > commands + 25)
    assert servos.state()["goals"] == goals
    assert arm.state is Lifecycle.ACTIVE


def test_motion_infeasible_for_five_joints_is_reported(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    stream(arm, lease, np.array([0.0, 0.03, 0.0, 0.1, 0.0, 0.0]), 0.5)
    sent = send(arm, lease, np.array([0.0, 0.03, 0.0, 0.1, 0.0, 0.0]))
    (lost,) = sent.adjustments
    assert lost.limit == "joints: angular"
    assert lost.requested == pytest.approx(0.1)
    assert lost.allowed < 0.03
    np.testing.assert_allclose(sent.command.twist[:3], [0.0, 0.03, 0.0], atol=1e-9)
    assert "joints: angular" in str(arm.health()["not_followed"])
    assert send(arm, lease, np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])).adjustments != sent.adjustments
    # The tool stays upright although a tilt was commanded.
    T = arm.tcp(0.5).value.T_base_tcp
    assert T[2, 2] < -np.cos(np.deg2rad(2.0))


def test_stop_needs_no_lease_and_releasing_stops(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    stream(arm, lease, UP, 0.3)
    arm.stop()
    wait(arm.at_rest)
    stream(arm, lease, UP, 0.3)
    arm.release(lease)
    wait(arm.at_rest)
    with pytest.raises(CommandRejected) as caught:
        send(arm, lease, UP)
    assert caught.value.reason is Rejection.LEASE


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        ("drop", "missed"),
        ("corrupt", "corrupt"),
        ("short", "corrupt"),
        ("wild", "corrupt"),
        ("jump", "implausible"),
        ("foreign", "unexpected"),
        ("out_of_order", "late"),
    ],
)
def test_a_few_losses_are_counted_and_survived(
    arm: FeetechSerialArm, servos: EmulatorInStep, fault: str, counter: str
) -> None:
    lease = activate(arm)
    before = int(arm.health()[counter])
    seq = arm.joints().seq
    servos.fault(fault, 3)
    wait(lambda: int(arm.health()[counter]) >= before + 3)
    wait(lambda: arm.joints().seq > seq + 4)
    stream(arm, lease, UP, 0.1)
    assert arm.state is Lifecycle.ACTIVE
    wait(arm.at_rest)
    servos.wait_for(still=True)
    seq = arm.joints().seq
    wait(lambda: arm.joints().seq > seq + 1)
    np.testing.assert_allclose(arm.joints(0.5).value.q, servos.state()["q_rad"], atol=2 * TICK_RAD)


def test_late_replies_are_not_mistaken_for_fresh_ones(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    activate(arm)
    # Two and a half cycles: every answer arrives while another request is being waited for.
    servos.fault("delay", 0.125)
    wait(lambda: int(arm.health()["late"]) >= 5)
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, TransportTimeout)
    with pytest.raises(StaleData):
        arm.tcp(0.1)


def test_a_silent_servo_is_a_fault_and_the_others_hold(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    servos.fault("silent", 4)
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, TransportTimeout)
    assert "servo 5" in str(arm.fault)
    with pytest.raises(StaleData):
        arm.joints(0.1)
    with pytest.raises(CommandRejected):
        send(arm, lease, UP)
    with pytest.raises(TransportTimeout):
        arm.recover(TOKEN)
    assert faulted(arm)
    servos.clear("silent")
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY
    energising = servos.state()["energising"]
    arm.activate()
    # All had held, so none was switched on again.
    assert (servos.state()["enabled"], servos.state()["energising"]) == (5, energising)


def test_no_step_is_sent_while_a_servo_is_silent(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    sideways = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
    stream(arm, lease, sideways, 0.5)
    before = servos.fault("silent", 4)["goals"][0]
    while not faulted(arm):
        with suppress(CommandRejected, StaleData):
            send(arm, lease, sideways)
        pause(0.01)
    # Sixteen cycles of 9 ticks would be 144; the step under way and two more, of two periods at most, are 54.
    assert 0 <= servos.state()["goals"][0] - before <= 54


@pytest.mark.parametrize(
    ("bits", "fault_class", "needs"),
    [(0x20, FaultClass.OVERLOAD, Remedy.RECOVER), (0x01, FaultClass.ELECTRICAL, Remedy.OPERATOR)],
)
def test_a_servo_s_fault_is_decoded_and_only_recovered_on_request(
    arm: FeetechSerialArm, servos: EmulatorInStep, bits: int, fault_class: FaultClass, needs: Remedy
) -> None:
    activate(arm)
    servos.fault("fault_bits", [1, bits])
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceFault)
    assert (arm.fault.vendor_code, arm.fault.fault_class, arm.fault.needs) == (bits, fault_class, needs)
    assert "servo 2" in arm.fault.name
    with pytest.raises(DeviceFault):
        arm.recover(TOKEN)
    assert faulted(arm)
    # Overload is latched until the torque is off, which only recover does; other faults an operator clears.
    assert servos.state()["torque"] == [True, needs is not Remedy.RECOVER, True, True, True]
    servos.clear("fault_bits")
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY
    assert servos.state()["status"] == [0] * 5
    arm.activate()
    assert servos.state()["enabled"] == 5


def test_a_blocked_joint_is_a_fault_and_is_pushed_no_longer(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    servos.fault("block", 0)
    until_ns = CLOCK.now_ns() + 10_000_000_000
    farthest = 0
    while not faulted(arm):
        assert CLOCK.now_ns() < until_ns
        with suppress(CommandRejected):
            send(arm, lease, np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
        state = servos.state()
        farthest = max(farthest, abs(state["goals"][0] - state["ticks"][0]))
        pause(0.01)
    assert isinstance(arm.fault, DeviceFault)
    assert arm.fault.fault_class is FaultClass.MOTION
    assert "joint pan" in arm.fault.name
    # The goal was never more than tracking_error_deg and three steps (of two periods at most) ahead of the servo.
    step_rad = 0.1 / position(state)[0] * 0.05
    assert np.deg2rad(4.0) < farthest * TICK_RAD < np.deg2rad(8.0) + 3 * step_rad
    wait(lambda: abs(servos.state()["goals"][0] - servos.state()["ticks"][0]) <= 1)
    assert servos.state()["enabled"] == 5


def test_frozen_servos_are_stale_then_a_fault(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    activate(arm)
    servos.freeze()
    try:
        wait(lambda: faulted(arm))
        assert isinstance(arm.fault, TransportTimeout)
        with pytest.raises(StaleData):
            arm.tcp(0.1)
    finally:
        servos.thaw()


def test_an_unplugged_adapter_is_lost_until_reconnected(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    activate(arm)
    servos.fault("unplug")
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceGone)
    with pytest.raises(DeviceGone):
        arm.recover(TOKEN)
    arm.disconnect()
    with pytest.raises(ConnectError):
        arm.connect()
    servos.clear("unplug")
    # The servos held all the time; connecting again leaves them so and notices it.
    assert servos.state()["enabled"] == 5
    arm.connect()
    assert arm.health()["enabled"] == 5
    assert servos.state()["enabled"] == 5


def test_a_servo_that_lost_power_is_noticed(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    arm.connect()
    arm.configure()
    servos.fault("restart", 2)
    # It has forgotten its torque limit.
    with pytest.raises(DeviceFault) as caught:
        arm.activate()
    assert caught.value.vendor_code == "brown-out"
    assert servos.state()["energising"] == 0
    arm.disconnect()
    activate(arm)
    servos.fault("restart", 2)
    wait(lambda: faulted(arm))
    assert isinstance(arm.fault, DeviceFault)
    assert (arm.fault.vendor_code, arm.fault.fault_class) == ("brown-out", FaultClass.ELECTRICAL)
    assert "servo 3" in arm.fault.name
    assert servos.state()["torque"] == [True, True, False, True, True]
    # Recovering sets the limits again and energises nothing; activation only switches on what was off.
    arm.recover(TOKEN)
    assert servos.state()["torque"] == [True, True, False, True, True]
    arm.activate()
    assert servos.state()["enabled"] == 5
    assert [entry for entry in servos.state()["log"] if ":40=01" in entry][-1] == "3:40=01"


def test_a_joint_outside_its_range_is_suspect_and_not_energised(port: Path, servos: EmulatorInStep) -> None:
    # Servo 2 (lift, turning the other way) from 1986 ticks over 0 to 4086, which is 2010 ticks or 177 deg beyond zero.
    servos.fault("carry", [1, -1996])
    with arm_in_step(port, CLOCK, config(port)) as arm:
        sample = arm.joints(0.5)
        assert sample.quality is Quality.SUSPECT
        arm.configure()
        with pytest.raises(DeviceFault) as caught:
            arm.activate()
        assert caught.value.fault_class is FaultClass.MOTION
        assert "joint lift" in caught.value.name
        assert servos.state()["energising"] == 0


def test_a_range_beside_the_seam_reads_on_beyond_it(port: Path, servos: EmulatorInStep) -> None:
    changes = [servo.model_dump() for servo in config(port).servos]
    changes[0] |= {"min_ticks": 1500, "max_ticks": 4000}
    # Servo 1 from 2048 to 4150, which it reports as 54: just beyond its range, not a turn away.
    servos.fault("carry", [0, 2102])
    with arm_in_step(port, CLOCK, config(port, servos=changes)) as arm:
        assert arm.health()["pan_ticks"] == 54
        assert arm.joints(0.5).value.q[0] == pytest.approx(2102 * TICK_RAD)


def test_deactivation_policies(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    arm.connect()
    arm.configure()
    arm.activate()
    for policy in (DeactivatePolicy.OFF, DeactivatePolicy.BRAKE):
        with pytest.raises(LifecycleError):
            arm.deactivate(policy)
        assert arm.state is Lifecycle.ACTIVE
    arm.deactivate(DeactivatePolicy.HOLD)
    held = servos.state()
    assert (held["enabled"], arm.state) == (5, Lifecycle.READY)
    arm.activate()
    assert servos.state()["goals"] == held["goals"]
    arm.deactivate(DeactivatePolicy.PARK_THEN_OFF)
    state = servos.state()
    assert state["enabled"] == 0
    np.testing.assert_allclose(np.rad2deg(state["q_rad"]), PARK_DEG, atol=1.0)
    arm.activate()
    arm.deactivate(DeactivatePolicy.OFF)
    assert servos.state()["enabled"] == 0


def test_disconnecting_holds_and_connecting_again_does_not_drop_it(
    arm: FeetechSerialArm, servos: EmulatorInStep
) -> None:
    lease = activate(arm)
    stream(arm, lease, UP, 0.2)
    arm.disconnect()
    held = servos.wait_for(still=True)
    assert held["enabled"] == 5
    arm.connect()
    arm.configure()
    seq = arm.joints().seq
    wait(lambda: arm.joints().seq > seq + 3)
    state = servos.state()
    assert (state["enabled"], state["goals"], state["energising"]) == (5, held["goals"], held["energising"])


def test_it_moves_to_joint_angles_and_refuses_impossible_ones(arm: FeetechSerialArm, servos: EmulatorInStep) -> None:
    lease = activate(arm)
    goal = np.deg2rad([5.0, 5.0, 95.0, 75.0, 10.0])
    arm.go_to_joints(goal, lease, speed_fraction=0.5)
    assert not arm.at_rest()
    wait(arm.at_rest)
    np.testing.assert_allclose(servos.wait_for(still=True)["q_rad"], goal, atol=np.deg2rad(0.2))
    for bad, reason in (
        (np.full(5, np.nan), Rejection.NON_FINITE),
        (np.zeros(6), Rejection.SHAPE),
        (np.full(5, 3.0), Rejection.LIMIT),
    ):
        with pytest.raises(CommandRejected) as caught:
            arm.go_to_joints(bad, lease)
        assert caught.value.reason is reason


def test_a_missing_port_and_a_silent_servo_are_distinguished(port: Path, servos: EmulatorInStep) -> None:
    with pytest.raises(ConnectError, match="cannot open"):
        arm_in_step(port, CLOCK, config(port.parent / "nowhere")).connect()
    servos.fault("silent", 1)
    arm = arm_in_step(port, CLOCK, config(port))
    with pytest.raises(ConnectError) as caught:
        arm.connect()
    assert [type(cause) for cause in caught.value.causes] == [TransportTimeout]
    assert "servo 2" in str(caught.value.causes[0])
    assert arm.state is Lifecycle.DISCONNECTED


@pytest.mark.parametrize(
    ("register", "data", "key"),
    [
        (3, "0105", "servos[3].model"),
        (8, "00", "servos[3].acknowledges"),
        (9, "b80b", "servos[3]"),
        (11, "e803", "servos[3]"),
        (18, "1c", "servos[3].multi_turn"),
        (31, "5508", "servos[3].homing_offset_ticks"),
        (33, "01", "servos[3].mode"),
    ],
)
def test_servos_that_are_not_as_expected_are_refused(
    arm: FeetechSerialArm, servos: EmulatorInStep, register: int, data: str, key: str
) -> None:
    servos.fault("registers", [3, register, data])
    arm.connect()
    with pytest.raises(ConfigError) as caught:
        arm.configure()
    assert caught.value.key == key
    assert arm.state is Lifecycle.PASSIVE
    assert servos.state()["log"] == []


def test_a_return_delay_that_leaves_no_time_is_refused(port: Path, servos: EmulatorInStep) -> None:
    # 250 units of 2 us: five servos wait 2.5 ms, and 200 Hz would leave 4 ms for a cycle of 5.66 ms.
    for index in range(5):
        servos.fault("registers", [index, 7, "fa"])
    with arm_in_step(port, CLOCK, config(port, rate_hz=200.0, max_silence_s=0.08)) as arm:
        with pytest.raises(ConfigError) as caught:
            arm.configure()
        assert caught.value.key == "rate_hz"


@pytest.mark.parametrize(
    "changes",
    [
        {"limits": {"tcp_speed_m_s": 0.0}},
        {"limits": {"tcp_accel_m_s2": float("nan")}},
        {"tracking_error_deg": 45.0},
        {"rate_hz": 1000.0},
        {"max_silence_s": 1.0},
        {"max_silence_s": 0.05},
        {"servos": [{"id": 1}, {"id": 1}]},
        {"servos": [{"id": 1, "min_ticks": 3000, "max_ticks": 100}]},
        {"servos": [{"id": 254}]},
        {"servos": [{"id": 1, "max_ticks": 4096}]},
        {"servos": [{"id": 1, "direction": 0}]},
        {"park_deg": [0.0]},
        {"park_deg": None, "on_disconnect": "park_then_off"},
        {"watchdog_s": 0.1},
    ],
)
def test_impossible_configurations_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        config(Path("/dev/null"), **changes)


def test_a_calibration_that_leaves_a_joint_no_range_is_refused() -> None:
    changes = [servo.model_dump() for servo in config(Path("x")).servos]
    # The elbow's range is 0 to 155 deg; turned the wrong way its servo would end at 1 deg.
    changes[2] |= {"direction": -1, "zero_ticks": 0}
    with pytest.raises(ConfigError) as caught:
        FeetechSerialArm("arm", config(Path("x"), servos=changes), CLOCK)
    assert caught.value.key == "servos[2]"
    with pytest.raises(ConfigError):
        FeetechSerialArm("arm", config(Path("x"), servos=changes[:4], park_deg=None), CLOCK)


def test_a_park_pose_outside_the_joints_ranges_is_refused() -> None:
    with pytest.raises(ConfigError) as caught:
        FeetechSerialArm("arm", config(Path("x"), park_deg=[0.0, 0.0, -10.0, 0.0, 0.0]), CLOCK)
    assert caught.value.key == "park_deg[2]"


def test_the_calibration_s_hash_changes_with_any_number() -> None:
    servos = [servo.model_dump() for servo in config(Path("x")).servos]
    known = config(Path("x")).calibration_hash
    assert config(Path("y"), rate_hz=15.0).calibration_hash == known
    for key, value in (("zero_ticks", 2049), ("direction", -1), ("min_ticks", 1), ("homing_offset_ticks", 1)):
        assert config(Path("x"), servos=[servos[0] | {key: value}, *servos[1:]]).calibration_hash != known


def test_a_servo_that_counts_below_zero_is_named_before_it_is_enabled(
    arm: FeetechSerialArm, servos: EmulatorInStep
) -> None:
    servos.fault("turn_off", 2)
    arm.connect()
    assert int(arm.health()["elbow_ticks"]) < 0
    arm.configure()
    with pytest.raises(DeviceFault, match="outside 0 to 4095") as caught:
        arm.activate()
    assert caught.value.needs is Remedy.OPERATOR
    assert servos.state()["energising"] == 0
