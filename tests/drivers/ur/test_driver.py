"""The UR driver beside its emulator, on one simulated time."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tests.helpers.bus_arms import CLOCK, in_step, pause
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import (
    CommandRejected,
    ConnectError,
    CorruptMessage,
    DeviceError,
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
from touchcell.drivers.core.protocols import (
    HealthSource,
    JointGoal,
    JointSource,
    NativeWatchdog,
    StopCategory,
    Stoppable,
    TcpSource,
    TwistSink,
    WrenchSource,
)
from touchcell.drivers.kinematics.chain import ChainDescription
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur import control, driver
from touchcell.drivers.ur import state as state_module
from touchcell.drivers.ur.driver import SPEC, UrArm, UrConfig
from touchcell.drivers.ur.modes import (
    SAFETY_FAULTS,
    RobotMode,
    RuntimeState,
    SafetyBits,
    SafetyMode,
    power_fault,
    safety_fault,
)
from touchcell.drivers.ur.rig import arm_in_step, config_of, host_of, rig_in_step
from touchcell.drivers.ur.state import StateReader
from touchcell.testing.emulation.lockstep import EmulatorInStep, Lockstep, emulator_in_step

pytest.importorskip("rtde_control", reason="pip install touchcell[ur]")

ADDRESSES = itertools.count(os.getpid() % 40_000 * 100)
DEADLINE_S = 5.0
TOOL_MM_DEG = (0.0, 0.0, 100.0, 0.0, 0.0, 0.0)
WATCHDOG_S = 1.0 / config_of(0).watchdog_hz
TOKEN = OperatorToken("test", 0)


@pytest.fixture
def address() -> int:
    """An address that no other test uses."""
    return next(ADDRESSES)


@pytest.fixture
def emulator(address: int, tmp_path: Path) -> Iterator[EmulatorInStep]:
    """A fresh emulated controller."""
    yield from in_step(rig_in_step(tmp_path, address))


@pytest.fixture
def arm(emulator: EmulatorInStep, address: int) -> Iterator[UrArm]:
    """A connected arm in READY."""
    device = arm_in_step(config_of(address), CLOCK)
    device.connect()
    device.configure()
    yield device
    device.disconnect()


@pytest.fixture
def lease(arm: UrArm) -> Lease:
    """The lease of an activated arm."""
    arm.activate()
    return arm.acquire("test")


def wait_until(condition: Callable[[], bool], what: str) -> None:
    deadline_ns = CLOCK.now_ns() + round(1e9 * DEADLINE_S)
    while not condition():
        assert CLOCK.now_ns() < deadline_ns, f"no {what} within {DEADLINE_S} s"
        pause(0.002)


def wait_faulted(arm: UrArm) -> DeviceError:
    wait_until(lambda: arm.state is Lifecycle.FAULTED, "fault")
    assert arm.fault is not None
    return arm.fault


def push(arm: UrArm, lease: Lease, twist: list[float], *, ttl_s: float = 0.2) -> None:
    arm.send_twist(TwistCommand(np.array(twist), TwistFrame.BASE, CLOCK.now_ns(), ttl_s), lease)


def drive(arm: UrArm, lease: Lease, twist: list[float], emulator: EmulatorInStep) -> None:
    """Stream until the arm has reached the twist."""

    def reached() -> bool:
        push(arm, lease, twist)
        return bool(np.allclose(emulator.state()["twist"], twist, atol=2e-3))

    wait_until(reached, "motion")


# Configuration and static facts


def test_an_arm_of_another_model_than_its_chain_is_not_activated(emulator: EmulatorInStep, address: int) -> None:
    other = arm_in_step(config_of(address).model_copy(update={"chain": "ur10e"}), CLOCK)
    other.connect()
    try:
        other.configure()
        with pytest.raises(DeviceFault, match="from the one its chain gives") as caught:
            other.activate()
        assert caught.value.fault_class is FaultClass.CONFIGURATION
    finally:
        other.disconnect()


def test_joints_are_kept_from_their_limits(arm: UrArm, lease: Lease) -> None:
    sample = arm.joints(0.2)
    arm._chain.upper[5] = sample.value.q[5] + np.deg2rad(1.0)
    J = arm._chain.jacobian(sample.value.q)
    # A zero twist first: a command from rest begins with the acceleration of a millisecond.
    arm.send_twist(TwistCommand(np.zeros(6), TwistFrame.BASE, CLOCK.now_ns(), 0.5), lease)
    CLOCK.sleep_until_ns(CLOCK.now_ns() + 150_000_000)
    sent = arm.send_twist(TwistCommand(0.4 * J[:, 5], TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
    np.testing.assert_allclose(
        np.linalg.solve(J, sent.command.twist), [0, 0, 0, 0, 0, arm._chain.speed[5] / 5.0], atol=1e-3
    )
    assert "joint wrist_3" in [adjustment.limit for adjustment in sent.adjustments]
    # Straight after the other, a command back would be held to the way out by acceleration and jerk.
    arm.stop()
    back = arm.send_twist(TwistCommand(-0.4 * J[:, 5], TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
    assert "joint wrist_3" not in [adjustment.limit for adjustment in back.adjustments]


def test_importing_the_driver_imports_no_sdk() -> None:
    code = (
        "import sys, touchcell.drivers.ur.driver\n"
        "sys.exit(any(m in sys.modules for m in ('rtde_control', 'rtde_receive')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_protocols_are_those_of_the_record() -> None:
    protocols = {
        TcpSource,
        JointSource,
        WrenchSource,
        TwistSink,
        Stoppable,
        JointGoal,
        HealthSource,
        NativeWatchdog,
    }
    arm = UrArm("ur", UrConfig(host="127.0.0.1", flange_to_tcp_mm_deg=TOOL_MM_DEG), VirtualClock())
    assert protocols == SPEC.capabilities.provides
    assert all(isinstance(arm, protocol) for protocol in protocols)


@pytest.mark.parametrize(
    "wrong",
    [
        {"host": ""},
        {"limits": {"tcp_speed_m_s": 0.0}},
        {"limits": {"tcp_speed_m_s": math.nan}},
        {"limits": {"tcp_accel_m_s2": -1.0}},
        {"stop_accel_m_s2": 0.2},
        {"watchdog_hz": 0.0},
        {"watchdog_hz": 1.0},
        {"state_timeout_s": math.inf},
        {"flange_to_tcp_mm_deg": (0.0, 0.0)},
        {"tcp_speed": 0.1},
    ],
)
def test_wrong_configuration_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        UrConfig(**({"host": "10.0.0.5", "flange_to_tcp_mm_deg": TOOL_MM_DEG} | wrong))


def test_the_tool_has_no_default() -> None:
    with pytest.raises(ValidationError):
        UrConfig(host="10.0.0.5")  # type: ignore[call-arg]


@pytest.mark.parametrize("mode", SafetyMode)
def test_every_safety_mode_allows_motion_or_is_a_named_fault(mode: SafetyMode) -> None:
    fault = safety_fault("ur", mode, 0)
    if mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
        assert fault is None
    else:
        assert fault is not None
        assert fault.name == SAFETY_FAULTS[mode].name
        assert fault.vendor_code == f"safety_mode {int(mode)}"
        assert fault.hint


@pytest.mark.parametrize("bit", SafetyBits)
def test_every_safety_bit_allows_motion_or_is_a_fault_even_in_normal_mode(bit: SafetyBits) -> None:
    fault = safety_fault("ur", SafetyMode.NORMAL, int(bit))
    assert (fault is None) == (bit in (SafetyBits.NORMAL_MODE, SafetyBits.REDUCED_MODE))


@pytest.mark.parametrize("mode", RobotMode)
def test_only_a_running_arm_may_be_active(mode: RobotMode) -> None:
    assert (power_fault("ur", mode) is None) == (mode is RobotMode.RUNNING)


# State, without a controller


class Stream:
    """A state stream that delivers one packet with the given present values at each poll."""

    connected = True

    def __init__(self) -> None:
        self.timestamp = 1.0
        self.pose = [0.4, -0.1, 0.3, 0.0, 3.0, 0.0]
        self.q = [0.0] * 6
        self.robot_mode = 7

    def receive(self) -> list[dict[str, ur_codec.Value]]:
        zero = (0.0,) * 6
        return [
            {
                "timestamp": self.timestamp,
                "actual_q": tuple(self.q),
                "actual_qd": zero,
                "target_qd": zero,
                "actual_TCP_pose": tuple(self.pose),
                "actual_TCP_speed": zero,
                "actual_TCP_force": zero,
                "robot_mode": self.robot_mode,
                "safety_mode": 1,
                "safety_status_bits": 1,
                "runtime_state": 1,
                "target_speed_fraction": 1.0,
                "joint_temperatures": zero,
            }
        ]


def test_a_packet_read_late_does_not_look_fresh() -> None:
    clock, receive = VirtualClock(), Stream()
    reader = StateReader(receive, clock)
    for _ in range(20):
        receive.timestamp += 0.002
        clock.advance_s(0.002)
        reader.poll()
    receive.timestamp += 0.002
    clock.advance_s(0.5)
    snapshot = reader.poll()
    assert snapshot is not None
    assert snapshot.age_s(clock.now_ns()) == pytest.approx(0.498, abs=2e-4)


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_ages_stay_true_while_the_clocks_drift_apart(drift: float) -> None:
    clock, receive = VirtualClock(), Stream()
    reader = StateReader(receive, clock)
    for _ in range(5_000):
        receive.timestamp += 0.01 * (1.0 + drift)
        clock.advance_s(0.01)
        snapshot = reader.poll()
    assert snapshot is not None
    assert snapshot.age_s(clock.now_ns()) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pose", [math.nan] * 6),
        ("pose", [math.inf, 0, 0, 0, 0, 0]),
        ("pose", [3.5, 0, 0, 0, 0, 0]),
        ("pose", [0, 0, 0, 7.0, 0, 0]),
        ("q", [7.0, 0, 0, 0, 0, 0]),
        ("q", [0.5, 0, 0, 0, 0, 0]),
        ("robot_mode", 99),
        ("timestamp", math.nan),
    ],
)
def test_bad_packets_are_counted_and_never_substituted(field: str, value: Any) -> None:
    receive = Stream()
    reader = StateReader(receive, VirtualClock())
    good = reader.poll()
    receive.timestamp += 0.002
    setattr(receive, field, value)
    assert reader.poll() is good
    assert reader.corrupt == 1
    assert not reader.drops_too_many


def test_an_older_packet_is_out_of_order() -> None:
    receive = Stream()
    reader = StateReader(receive, VirtualClock())
    good = reader.poll()
    receive.timestamp -= 0.002
    assert reader.poll() is good
    assert reader.out_of_order == 1


def test_eleven_bad_packets_of_fifty_are_over_the_budget() -> None:
    receive = Stream()
    reader = StateReader(receive, VirtualClock())
    for i in range(50):
        receive.timestamp += 0.002
        receive.robot_mode = 99 if i % 5 == 0 else 7
        reader.poll()
    assert not reader.drops_too_many
    receive.timestamp += 0.002
    receive.robot_mode = 99
    reader.poll()
    receive.timestamp += 0.002
    reader.poll()
    assert reader.drops_too_many
    reader.reset_statistics()
    assert not reader.drops_too_many


# Connecting


def test_connecting_and_configuring_changes_nothing(arm: UrArm, emulator: EmulatorInStep) -> None:
    state = emulator.state()
    assert state["energising"] == 0
    assert state["commands"] == {}
    pose = arm.tcp(0.2).value.T_base_tcp
    # No tool is set on the pendant; the pose is that of the configured one, 100 mm ahead of the flange.
    flange = np.array(state["T_base_tcp"])
    np.testing.assert_allclose(pose[:3, 3], flange[:3, 3] + 0.1 * flange[:3, 2], atol=1e-9)
    assert arm.health()["pendant_tool_differs"]
    np.testing.assert_allclose(arm.joints(0.2).value.q, state["q"], atol=1e-12)
    assert arm.health()["robot_mode"] == "RUNNING"
    with pytest.raises(LifecycleError):
        arm.watchdog_s()


def test_an_unreachable_controller_is_a_connect_error(address: int) -> None:
    arm = UrArm("ur", UrConfig(host=host_of(address), flange_to_tcp_mm_deg=TOOL_MM_DEG), CLOCK)
    with pytest.raises(ConnectError) as caught:
        arm.connect()
    assert isinstance(caught.value.causes[0], ConnectionRefusedError)
    assert arm.state is Lifecycle.DISCONNECTED


def test_a_frozen_controller_does_not_block(emulator: EmulatorInStep, address: int) -> None:
    emulator.fault("pause")
    config = UrConfig(host=host_of(address), flange_to_tcp_mm_deg=TOOL_MM_DEG, connect_timeout_s=0.2)
    with pytest.raises(ConnectError) as caught:
        UrArm("ur", config, CLOCK).connect()
    assert isinstance(caught.value.causes[0], TransportTimeout)


def test_a_missing_sdk_names_the_extra(monkeypatch: pytest.MonkeyPatch, address: int) -> None:
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(ConnectError, match=r"touchcell\[ur\]"):
        UrArm("ur", UrConfig(host=host_of(address), flange_to_tcp_mm_deg=TOOL_MM_DEG), CLOCK).connect()


# Activation


def test_activation_proves_the_watchdog_and_sets_the_tool(arm: UrArm, emulator: EmulatorInStep) -> None:
    arm.activate()
    state = emulator.state()
    assert state["watchdog_trips"] == 1
    assert state["watchdog_hz"] == pytest.approx(1.0 / WATCHDOG_S)
    assert arm.watchdog_s() == pytest.approx(WATCHDOG_S)
    assert state["flange_to_tcp"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    np.testing.assert_allclose(arm.tcp(0.2).value.T_base_tcp[:3, 3], state["position_m"], atol=1e-12)
    assert state["travel_m"] == 0.0
    # The keeper kicks: an idle arm stays active beyond many watchdog periods.
    wait_until(lambda: emulator.state()["t_s"] > state["t_s"] + 0.5, "half a second")
    assert emulator.state()["watchdog_trips"] == 1
    assert arm.state is Lifecycle.ACTIVE


def test_activation_is_refused(arm: UrArm, emulator: EmulatorInStep) -> None:
    refusals = (
        ("local_control", True, "local control"),
        ("registers_in_use", True, "in use"),
        ("speed_slider", 0, "slider"),
    )
    for fault, value, message in refusals:
        emulator.fault(fault, value)
        wait_until(lambda fault=fault: fault != "speed_slider" or arm.health()["speed_fraction"] == 0, "slider")  # type: ignore[misc]
        with pytest.raises(DeviceError, match=message):
            arm.activate()
        assert arm.state is Lifecycle.READY
        emulator.clear(fault)
    state = emulator.state()
    assert state["energising"] == 0
    assert state["runtime_state"] == "STOPPED"


def test_a_foreign_program_is_not_stopped(arm: UrArm, emulator: EmulatorInStep) -> None:
    emulator.fault("other_program")
    wait_until(lambda: arm.health()["runtime_state"] == "PLAYING", "program")
    with pytest.raises(DeviceFault, match="another program"):
        arm.activate()
    assert emulator.state()["runtime_state"] == "PLAYING"
    emulator.fault("protective_stop")
    wait_faulted(arm)
    wait_until(lambda: _recovers(arm), "recovery")
    assert emulator.state()["runtime_state"] == "PAUSED", "neither ended nor resumed"


def test_activation_powers_the_arm(arm: UrArm, emulator: EmulatorInStep) -> None:
    emulator.fault("power_off")
    wait_until(lambda: arm.health()["robot_mode"] == "POWER_OFF", "power off")
    arm.activate()
    assert emulator.state()["energised"]
    arm.deactivate(DeactivatePolicy.BRAKE)
    assert not emulator.state()["energised"]
    assert arm.state is Lifecycle.READY


# Motion


def test_twists_are_of_the_tool_along_base_axes(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    twist = [0.03, -0.02, 0.01, 0.1, -0.05, 0.15]
    drive(arm, lease, twist, emulator)
    wait_until(lambda: bool(np.allclose(arm.tcp(0.2).value.twist, twist, atol=2e-3)), "twist in the state")


def test_twists_along_tool_axes_follow_the_tool(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    R = arm.tcp(0.2).value.T_base_tcp[:3, :3]

    def reached() -> bool:
        command = TwistCommand(np.array([0, 0, -0.05, 0, 0, 0]), TwistFrame.TCP, CLOCK.now_ns(), 0.2)
        arm.send_twist(command, lease)
        return bool(np.allclose(emulator.state()["twist"][:3], R @ [0, 0, -0.05], atol=2e-3))

    wait_until(reached, "motion along the tool's axis")


def test_the_time_to_live_stops_the_arm(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0, 0, -0.05, 0, 0, 0], emulator)
    before_m = emulator.state()["travel_m"]
    push(arm, lease, [0, 0, -0.05, 0, 0, 0], ttl_s=0.1)
    state = emulator.wait_for(moving=False)
    assert arm.health()["ttl_stops"] == 1
    assert state["watchdog_trips"] == 1, "only the one of the activation"
    travelled_m = state["travel_m"] - before_m
    assert 0.004 < travelled_m < 0.05 * (0.1 + 0.15) + 0.05**2 / (2 * 2.0)
    assert arm.state is Lifecycle.ACTIVE
    wait_until(arm.at_rest, "rest")


def test_stop_is_at_once_and_keeps_the_lease(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    push(arm, lease, [0.05, 0, 0, 0, 0, 0], ttl_s=1.0)
    arm.stop()
    emulator.wait_for(moving=False)
    assert arm.health()["ttl_stops"] == 0
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)


@pytest.mark.parametrize("category", [StopCategory.STOP_THEN_REMOVE_POWER, StopCategory.REMOVE_POWER])
def test_stops_that_remove_power(arm: UrArm, lease: Lease, emulator: EmulatorInStep, category: StopCategory) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    arm.stop(category)
    emulator.wait_for(robot_mode="POWER_OFF", moving=False)
    assert arm.state is Lifecycle.READY
    assert arm.owner is None
    with pytest.raises(CommandRejected):
        push(arm, lease, [0.05, 0, 0, 0, 0, 0])


def test_disconnecting_does_not_cancel_the_removal_of_power(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    arm.stop(StopCategory.STOP_THEN_REMOVE_POWER)
    arm.disconnect()
    assert emulator.state()["robot_mode"] == "POWER_OFF"


def test_joint_goal_arrives_refuses_twists_and_can_be_stopped(
    arm: UrArm, lease: Lease, emulator: EmulatorInStep
) -> None:
    drive(arm, lease, [0.02, 0, 0, 0, 0, 0], emulator)
    with pytest.raises(CommandRejected) as caught:
        arm.go_to_joints(np.zeros(6), lease)
    assert caught.value.reason is Rejection.MODE
    arm.stop()
    wait_until(arm.at_rest, "rest")
    goal = arm.joints().value.q + 0.1
    arm.go_to_joints(goal, lease, speed_fraction=1.0)
    assert not arm.at_rest()
    with pytest.raises(CommandRejected, match="joint goal"):
        push(arm, lease, [0.01, 0, 0, 0, 0, 0])
    wait_until(arm.at_rest, "arrival")
    np.testing.assert_allclose(emulator.state()["q"], goal, atol=1e-9)
    arm.go_to_joints(goal + 1.0, lease, speed_fraction=1.0)
    wait_until(lambda: emulator.state()["moving"], "motion")
    arm.stop()
    wait_until(arm.at_rest, "rest")
    assert np.abs(np.array(emulator.state()["q"]) - goal).max() < 0.9
    drive(arm, lease, [0.02, 0, 0, 0, 0, 0], emulator)
    assert emulator.state()["runtime_state"] == "PLAYING"


@pytest.mark.parametrize(
    ("q", "fraction", "reason"),
    [
        (np.full(6, math.nan), 0.1, Rejection.NON_FINITE),
        (np.zeros(5), 0.1, Rejection.SHAPE),
        (np.full(6, 7.0), 0.1, Rejection.LIMIT),
        (np.zeros(6), 1.5, Rejection.LIMIT),
        (np.zeros(6), math.nan, Rejection.NON_FINITE),
    ],
)
def test_bad_joint_goals_are_not_sent(q: np.ndarray, fraction: float, reason: Rejection) -> None:
    arm = UrArm("ur", UrConfig(host="127.0.0.1", flange_to_tcp_mm_deg=TOOL_MM_DEG), VirtualClock())
    with pytest.raises(CommandRejected) as caught:
        arm.go_to_joints(q, arm.acquire("test"), speed_fraction=fraction)
    assert caught.value.reason in (reason, Rejection.MODE)


def test_the_wrench_is_the_external_wrench_on_the_tool(arm: UrArm, emulator: EmulatorInStep) -> None:
    wrench = [1.0, -2.0, 3.0, 0.1, 0.2, -0.3]
    emulator.fault("wrench", wrench)
    # Measured where the pendant's tool is, at the flange; told at the configured one, 100 mm ahead of it.
    lever_m = 0.1 * np.array(emulator.state()["T_base_tcp"])[:3, 2]
    told = [*wrench[:3], *(np.array(wrench[3:]) - np.cross(lever_m, wrench[:3]))]
    wait_until(lambda: bool(np.allclose(arm.wrench(0.2).value, told)), "wrench")
    emulator.fault("pendant_tool", [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    wait_until(lambda: arm.wrench(0.2).value.tolist() == wrench, "wrench")


# Faults


def test_transient_trouble_is_counted_and_survived(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    for fault, counter in (("nan", "corrupt_packets"), ("corrupt", "corrupt_packets"), ("drop", None)):
        before = arm.health()["corrupt_packets"]
        emulator.fault(fault, 8)
        if counter is not None:
            wait_until(lambda before=before: arm.health()["corrupt_packets"] > before, f"{fault} packet")  # type: ignore[misc]
        sample = arm.tcp(0.2).value
        assert np.isfinite(sample.T_base_tcp).all()
        assert np.abs(sample.T_base_tcp[:3, 3]).max() < 1.0
    emulator.fault("out_of_order", 5)
    push(arm, lease, [0.01, 0, 0, 0, 0, 0])
    assert arm.state is Lifecycle.ACTIVE


def test_lasting_nonsense_is_a_fault(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0.02, 0, 0, 0, 0, 0], emulator)
    emulator.fault("nan", 100_000)
    assert isinstance(wait_faulted(arm), TransportTimeout | CorruptMessage)
    emulator.wait_for(moving=False)
    emulator.clear("nan")
    wait_until(lambda: _recovers(arm), "recovery")
    assert arm.state is Lifecycle.READY


def test_a_frozen_network_is_stale_then_a_fault_and_the_arm_stops(
    arm: UrArm, lease: Lease, emulator: EmulatorInStep
) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    emulator.fault("pause")
    with pytest.raises(StaleData):  # noqa: PT012
        while True:
            arm.tcp(0.2)
            pause(0.002)
    fault = wait_faulted(arm)
    assert isinstance(fault, TransportTimeout | DeviceGone)
    assert isinstance(fault.__cause__, StaleData)
    state = emulator.wait_for(moving=False)
    assert state["watchdog_trips"] == 2
    assert state["travel_since_command_m"] < 0.05 * (WATCHDOG_S + 0.01) + 0.001
    with pytest.raises(CommandRejected):
        push(arm, lease, [0.05, 0, 0, 0, 0, 0])
    emulator.clear("pause")


def test_unplugged_is_a_fault_that_a_person_recovers(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    emulator.fault("unplug")
    assert isinstance(wait_faulted(arm), DeviceGone)
    emulator.wait_for(moving=False, runtime_state="STOPPED")
    with pytest.raises(DeviceError):
        arm.recover(TOKEN)
    assert arm.state is Lifecycle.FAULTED
    emulator.clear("unplug")
    wait_until(lambda: _recovers(arm), "recovery")
    travel_m = emulator.state()["travel_m"]
    arm.activate()
    assert emulator.state()["travel_m"] == travel_m
    drive(arm, arm.acquire("again"), [0.05, 0, 0, 0, 0, 0], emulator)


def _recovers(arm: UrArm) -> bool:
    try:
        arm.recover(TOKEN)
    except DeviceError:
        return False
    return True


def test_an_unplugged_arm_can_be_disconnected(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    emulator.kill()
    arm.disconnect()
    assert arm.state is Lifecycle.DISCONNECTED
    assert arm.fault is None


def test_a_restarted_controller_is_a_fault(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    emulator.fault("restart")
    assert isinstance(wait_faulted(arm), DeviceError)
    # ur-rtde reconnects by itself; nothing may start the arm again.
    t_s = emulator.state()["t_s"]
    wait_until(lambda: emulator.state()["t_s"] > t_s + 0.3, "time")
    state = emulator.state()
    assert not state["moving"]
    assert state["runtime_state"] == "STOPPED"
    arm.recover(TOKEN)
    arm.activate()
    assert emulator.state()["energised"]


def test_a_protective_stop_ends_the_program_and_waits_for_a_person(
    arm: UrArm, lease: Lease, emulator: EmulatorInStep
) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    emulator.fault("protective_stop")
    fault = wait_faulted(arm)
    assert isinstance(fault, DeviceFault)
    assert (fault.name, fault.vendor_code, fault.needs) == ("protective stop", "safety_mode 3", Remedy.RECOVER)
    # A protective stop only pauses the program: nothing may be left that could resume.
    emulator.wait_for(runtime_state="STOPPED", moving=False)
    assert arm.owner is None
    wait_until(lambda: _recovers(arm), "release of the protective stop")
    assert arm.state is Lifecycle.READY
    state = emulator.state()
    assert (state["safety_mode"], state["runtime_state"], state["moving"]) == ("NORMAL", "STOPPED", False)


def test_a_protective_stop_cannot_be_released_at_once() -> None:
    address = next(ADDRESSES)
    with Lockstep([driver, control, state_module]) as world:
        emulator = emulator_in_step(world, "ur", "--host", host_of(address)).start()
        arm = arm_in_step(config_of(address), world)
        arm.connect()
        arm.configure()
        emulator.fault("protective_stop")
        wait_faulted(arm)
        with pytest.raises(DeviceFault, match="remains"):
            arm.recover(TOKEN)
        assert arm.state is Lifecycle.FAULTED
        arm.disconnect()
        emulator.stop()


def test_an_emergency_stop_is_not_ours_to_clear(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    emulator.fault("emergency_stop")
    fault = wait_faulted(arm)
    assert isinstance(fault, DeviceFault)
    assert fault.needs is Remedy.OPERATOR
    with pytest.raises(DeviceFault, match="emergency"):
        arm.recover(TOKEN)
    assert arm.state is Lifecycle.FAULTED
    emulator.clear("emergency_stop")
    wait_until(lambda: _recovers(arm), "recovery")


@pytest.mark.parametrize(("fault", "code"), [("program_stop", "runtime_state 1"), ("power_off", "robot_mode 3")])
def test_stopped_from_the_pendant(arm: UrArm, lease: Lease, emulator: EmulatorInStep, fault: str, code: str) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    emulator.fault(fault)
    error = wait_faulted(arm)
    assert isinstance(error, DeviceFault)
    assert error.vendor_code == code
    assert RuntimeState.STOPPED.name == emulator.wait_for(moving=False)["runtime_state"]


def test_hold_leaves_the_arm_powered_and_park_is_refused(arm: UrArm, lease: Lease, emulator: EmulatorInStep) -> None:
    drive(arm, lease, [0.05, 0, 0, 0, 0, 0], emulator)
    with pytest.raises(LifecycleError, match="park"):
        arm.deactivate(DeactivatePolicy.PARK_THEN_OFF)
    arm.deactivate(DeactivatePolicy.HOLD)
    state = emulator.state()
    assert (state["moving"], state["runtime_state"], state["energised"]) == (False, "STOPPED", True)


def test_a_slider_at_zero_in_motion_is_a_fault(arm: UrArm, emulator: EmulatorInStep, lease: Lease) -> None:
    def move() -> bool:
        with contextlib.suppress(DeviceError):
            arm.send_twist(TwistCommand(np.array([0, 0, 0.02, 0, 0, 0]), TwistFrame.BASE, CLOCK.now_ns(), 0.2), lease)
        return arm.state is Lifecycle.FAULTED

    move()
    emulator.fault("speed_slider", 0.5)
    wait_until(lambda: arm.health()["speed_fraction"] == 0.5, "slider")
    twist = TwistCommand(np.array([0, 0, 0.02, 0, 0, 0]), TwistFrame.BASE, CLOCK.now_ns(), 0.2)
    assert "speed slider" in [a.limit for a in arm.send_twist(twist, lease).adjustments]
    emulator.fault("speed_slider", 0)
    wait_until(move, "fault")
    assert "speed slider" in str(arm.fault)
    with pytest.raises(DeviceFault, match="slider"):
        arm.recover(TOKEN)
    emulator.clear("speed_slider")
    wait_until(lambda: arm.health()["speed_fraction"] == 1.0, "slider")
    arm.recover(TOKEN)
    assert arm.state is Lifecycle.READY


def test_an_endless_wrist_may_turn_as_far_as_its_model_allows() -> None:
    ur3e = ChainDescription.named("ur3e")
    ends = np.deg2rad([max(-joint.lower_deg, joint.upper_deg) for joint in ur3e.joints])
    receive = Stream()
    receive.q = [0.0, 0.0, 0.0, 0.0, 0.0, 9.0]
    assert StateReader(receive, VirtualClock(), ends).poll() is not None
    reader = StateReader(receive, VirtualClock())
    assert reader.poll() is None
    assert "joint 6" in reader.last_corrupt
