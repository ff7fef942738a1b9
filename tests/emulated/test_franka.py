"""The Franka driver with the emulated controller, which provides the ground truth."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from tests.helpers.franka_harness import OPERATOR, FrankaHarness, eventually
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle
from touchcell.drivers.core.errors import (
    CommandRejected,
    ConnectError,
    CorruptMessage,
    DeviceFault,
    FaultClass,
    LifecycleError,
    Rejection,
    Remedy,
    StaleData,
    TransportError,
)
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.drivers.franka.driver import CAPABILITIES, FrankaConfig
from touchcell.drivers.franka.errors import ERRORS
from touchcell.geometry import se3

pytest.importorskip("franky")

E = TypeVar("E", bound=Exception)
TOOL_MM_DEG = (5.0, -3.0, 120.0, 10.0, -20.0, 30.0)
# 0.05 m/s for 0.2 s with the default factors: up with 0.65 m/s² and 325 m/s³, down with 2.6 m/s² and 1300 m/s³.
UP_S, DOWN_S = 0.05 / 0.65 + 0.65 / 325, 0.05 / 2.6 + 2.6 / 1300
TTL_DISTANCE_M = 0.05 * (0.2 - UP_S / 2 + DOWN_S / 2)


@pytest.fixture
def benches() -> Iterator[Callable[..., FrankaHarness]]:
    made: list[FrankaHarness] = []

    def make(**config: Any) -> FrankaHarness:
        made.append(FrankaHarness(**config))
        return made[-1]

    yield make
    for harness in made:
        harness.close()


@pytest.fixture
def harness(benches: Callable[..., FrankaHarness]) -> FrankaHarness:
    return benches()


def until(kind: type[E], call: Callable[[], object]) -> E:
    """Call again and again until it raises ``kind``."""
    raised: list[E] = []

    def raises() -> bool:
        try:
            call()
        except kind as error:
            raised.append(error)
        return bool(raised)

    eventually(raises)
    return raised[0]


def faulted(harness: FrankaHarness) -> DeviceFault:
    """Wait until the driver has noticed, and return its fault."""
    fault = until(DeviceFault, harness.arm.tcp)
    assert harness.arm.state is Lifecycle.FAULTED
    assert harness.arm.fault is fault
    return fault


def assert_travel(moved: np.ndarray, direction: np.ndarray) -> None:
    """Check that the tool moved that way, and no farther than the time-to-live allows.

    What a busy machine takes until the command is under way is taken from its time-to-live.
    """
    along = float(moved @ direction)
    np.testing.assert_allclose(moved, along * direction, atol=1e-4)
    assert 1e-4 < along <= TTL_DISTANCE_M + 2e-4


def test_its_spec_needs_no_sdk() -> None:
    code = "from touchcell.drivers.core.spec import DRIVERS; DRIVERS.load('franka')"
    code += "; import sys; assert 'franky' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert DRIVERS.load("franka").extra == "franka"


def test_a_missing_sdk_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "franky", None)
    arm = DRIVERS.load("franka").build(
        "arm",
        FrankaConfig(host="127.0.0.1", enforce_realtime=False, state_timeout_s=0.5),
        DriverContext(MonotonicClock()),
    )
    with pytest.raises(ConnectError, match=r"touchcell\[franka\]"):
        arm.connect()
    assert arm.state is Lifecycle.DISCONNECTED


@pytest.mark.parametrize(
    "wrong",
    [
        {"dynamics_factor": 0.0},
        {"dynamics_factor": 1.5},
        {"contact_force_limit_n": float("nan")},
        {"contact_torque_limit_nm": -1.0},
        {"limits": {"tcp_speed_m_s": 0.0}},
        {"host": ""},
        {"hots": "x"},
    ],
)
def test_wrong_configurations_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FrankaConfig.model_validate({"host": "127.0.0.1"} | wrong)


def test_connecting_configuring_and_activating_energise_nothing(harness: FrankaHarness) -> None:
    own = os.sched_getscheduler(0)
    harness.ready()
    truth = harness.truth()
    assert truth["energising"] == 0
    assert set(truth["received"]) == {"connect", "get_robot_model", "set_collision_behavior"}
    assert truth["force_threshold"] == [40, 40, 40, 10, 10, 10]
    harness.arm.activate()
    assert harness.truth()["energising"] == 0
    assert harness.arm.health()["mode"] == "Idle"
    assert os.sched_getscheduler(0) == own


def test_it_has_its_declared_capabilities(harness: FrankaHarness) -> None:
    for protocol in CAPABILITIES.provides:
        assert isinstance(harness.arm, protocol), protocol
    assert harness.arm.watchdog_s() == harness.truth()["watchdog_s"] == CAPABILITIES.max_watchdog_s


def test_an_unreachable_controller_is_a_connect_error(harness: FrankaHarness) -> None:
    harness.emulator.kill()
    with pytest.raises(ConnectError):
        harness.arm.connect()
    assert harness.arm.state is Lifecycle.DISCONNECTED


def test_a_second_owner_is_turned_away(harness: FrankaHarness) -> None:
    lease = harness.active()
    other = harness.another()
    with pytest.raises(ConnectError, match="one only"):
        other.connect()
    harness.send([0.02, 0, 0, 0, 0, 0], lease)
    harness.moved()


@pytest.mark.skipif(Path("/sys/kernel/realtime").exists(), reason="this kernel is a real-time one")
@pytest.mark.skipif(Path("/sys/kernel/realtime").exists(), reason="this kernel is a real-time one")
def test_a_missing_realtime_kernel_is_found_before_connecting(benches: Callable[..., FrankaHarness]) -> None:
    harness = benches(enforce_realtime=True)
    with pytest.raises(ConnectError, match="enforce_realtime: false"):
        harness.arm.connect()
    assert harness.truth()["requests"] == 0


def test_pose_and_joints_are_true(benches: Callable[..., FrankaHarness]) -> None:
    harness = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    harness.ready()
    truth = harness.truth()
    np.testing.assert_allclose(truth["F_T_EE"], se3.from_euler_mm_deg(TOOL_MM_DEG), atol=1e-7)
    np.testing.assert_allclose(harness.arm.tcp(1.0).value.T_base_tcp, truth["T_base_ee"], atol=1e-6)
    np.testing.assert_allclose(harness.arm.joints(1.0).value.q, truth["q"], atol=1e-6)


def test_before_the_tool_is_set_in_the_controller_the_pose_is_that_of_the_configured_one(
    benches: Callable[..., FrankaHarness],
) -> None:
    harness = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    harness.arm.connect()
    before = harness.arm.tcp(1.0).value
    assert np.abs(harness.truth()["F_T_EE"] - se3.from_euler_mm_deg(TOOL_MM_DEG)).max() > 0.01
    harness.arm.configure()
    np.testing.assert_allclose(before.T_base_tcp, harness.arm.tcp(1.0).value.T_base_tcp, atol=1e-6)


def test_a_pure_rotation_keeps_the_tool_centre_point_in_place(benches: Callable[..., FrankaHarness]) -> None:
    harness = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    lease = harness.active()
    T_before = np.array(harness.truth()["T_base_ee"])
    harness.send_at_speed([0, 0, 0, 0.1, -0.2, 0.05], lease, 0.5)
    harness.moved()
    eventually(lambda: np.linalg.norm(harness.arm.tcp().value.twist[3:]) > 0.2)
    np.testing.assert_allclose(harness.arm.tcp().value.twist[:3], 0, atol=1e-4)
    harness.rested()
    T_after = np.array(harness.truth()["T_base_ee"])
    np.testing.assert_allclose(T_after[:3, 3], T_before[:3, 3], atol=5e-5)
    turn = se3.log(T_after @ se3.inverse(T_before))[3:]
    np.testing.assert_allclose(turn / np.linalg.norm(turn), np.array([0.1, -0.2, 0.05]) / 0.2291288, atol=1e-3)


def test_a_twist_along_tool_axes_moves_along_the_tool(benches: Callable[..., FrankaHarness]) -> None:
    harness = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    lease = harness.active()
    T_before = np.array(harness.truth()["T_base_ee"])
    harness.send_at_speed([0, 0, 0.05, 0, 0, 0], lease, frame=TwistFrame.TCP)
    harness.moved()
    harness.rested()
    moved = harness.position() - T_before[:3, 3]
    assert_travel(moved, T_before[:3, 2])


def test_the_time_to_live_ends_the_motion_while_python_hangs(harness: FrankaHarness) -> None:
    lease = harness.active()
    before = harness.position()
    harness.send_at_speed([0.05, 0, 0, 0, 0, 0], lease)
    # A C call that keeps the interpreter lock: no Python thread of this process can do anything meanwhile.
    ctypes.PyDLL(None).usleep(700_000)
    truth = harness.truth()
    assert not truth["moving"]
    assert truth["mode"] == "idle"
    assert_travel(np.array(truth["position_m"]) - before, np.array([1.0, 0.0, 0.0]))


CLIENT = """
import sys, time
import numpy as np
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.franka.driver import FrankaArm, FrankaConfig
clock = MonotonicClock()
arm = FrankaArm("arm", FrankaConfig(host=sys.argv[1], enforce_realtime=False, state_timeout_s=0.5), clock)
arm.connect(); arm.configure(); arm.activate()
lease = arm.acquire("child")
while True:
    arm.send_twist(TwistCommand(np.array([0.05, 0, 0, 0, 0, 0]), TwistFrame.BASE, clock.now_ns(), 0.5), lease)
    time.sleep(0.02)
"""


@pytest.mark.parametrize("death", [signal.SIGKILL, signal.SIGSTOP])
def test_the_arm_stops_when_its_client_is_killed_or_frozen(harness: FrankaHarness, death: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", CLIENT, harness.config.host]) as client:
        try:
            eventually(lambda: harness.truth()["twist"][0] > 0.049)
            client.send_signal(death)
            truth = harness.emulator.wait_for(moving=False)
        finally:
            client.kill()
    assert truth["last_errors"] == ["communication_constraints_violation"]
    overrun = np.linalg.norm(np.array(truth["position_m"]) - truth["at_last_command_m"])
    # Twenty packets at 0.05 m/s, and the one that was answered.
    assert overrun <= 0.05 * 0.0211


def test_a_stream_at_50_hz_is_followed_without_reflex(harness: FrankaHarness) -> None:
    lease = harness.active()
    before = harness.position()
    for step in range(50):
        harness.send([0.03 * np.sin(2 * np.pi * step / 50), 0.02, 0, 0, 0, 0.1], lease)
        harness.clock.sleep_until_ns(harness.clock.now_ns() + 20_000_000)
    harness.rested()
    truth = harness.truth()
    assert truth["reflexes"] == 0
    assert truth["received"]["move"] <= 3
    moved = np.array(truth["position_m"]) - before
    assert moved[1] > 0.01
    assert abs(moved[2]) < 1e-4


def test_stop_ends_a_motion_and_keeps_the_lease(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.send([0.05, 0, 0, 0, 0, 0], lease, 1.0)
    harness.moved()
    harness.arm.stop()
    harness.rested()
    assert harness.arm.state is Lifecycle.ACTIVE
    assert harness.truth()["reflexes"] == 0
    harness.send([0.02, 0, 0, 0, 0, 0], lease)
    harness.moved()


def test_disconnecting_stops_first(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.send([0.05, 0, 0, 0, 0, 0], lease, 1.0)
    harness.moved()
    harness.arm.disconnect()
    truth = harness.emulator.wait_for(connected=False)
    assert (truth["moving"], truth["reflexes"], truth["mode"]) == (False, 0, "idle")


def test_only_holding_is_offered_when_it_is_deactivated(harness: FrankaHarness) -> None:
    harness.active()
    with pytest.raises(LifecycleError, match="brakes"):
        harness.arm.deactivate(DeactivatePolicy.BRAKE)
    harness.arm.deactivate(DeactivatePolicy.HOLD)
    assert harness.arm.state is Lifecycle.READY


def test_joint_goals_arrive(harness: FrankaHarness) -> None:
    lease = harness.active()
    goal = np.array([0.05, -0.75, 0.05, -2.3, 0.05, 1.6, 0.75])
    harness.arm.go_to_joints(goal, lease, speed_fraction=1.0)
    assert not harness.arm.at_rest()
    with pytest.raises(CommandRejected) as rejected:
        harness.send([0.02, 0, 0, 0, 0, 0], lease)
    assert rejected.value.reason is Rejection.MODE
    harness.rested()
    np.testing.assert_allclose(harness.truth()["q"], goal, atol=1e-6)


def test_a_goal_that_was_aborted_does_not_look_reached(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.arm.go_to_joints(np.array([0.3, -0.75, 0.05, -2.3, 0.05, 1.6, 0.75]), lease)
    harness.moved()
    harness.emulator.fault("reflex", "joint_reflex")
    assert until(DeviceFault, harness.rested).name == "joint_reflex"


def test_pose_goals_arrive_and_keep_the_speed_limit(benches: Callable[..., FrankaHarness]) -> None:
    harness = benches(dynamics_factor=0.3, limits={"tcp_speed_m_s": 0.05})
    lease = harness.active()
    goal = harness.arm.tcp().value.T_base_tcp @ se3.from_euler_mm_deg([10, -20, 5, 2, -3, 4])
    harness.arm.go_to_pose(goal, lease, speed_fraction=1.0)
    fastest = 0.0
    while not harness.arm.at_rest():
        fastest = max(fastest, float(np.linalg.norm(harness.truth()["twist"][:3])))
    np.testing.assert_allclose(harness.truth()["T_base_ee"], goal, atol=1e-5)
    assert 0.02 < fastest < 0.0501


def test_impossible_joint_goals_are_refused(harness: FrankaHarness) -> None:
    lease = harness.active()
    goals = [
        (np.full(7, np.nan), Rejection.NON_FINITE),
        (np.zeros(6), Rejection.SHAPE),
        (np.array([0, 0, 0, 0.5, 0, 1.5, 0]), Rejection.LIMIT),
    ]
    for goal, reason in goals:
        with pytest.raises(CommandRejected) as rejected:
            harness.arm.go_to_joints(goal, lease)
        assert rejected.value.reason is reason
    harness.arm.release(lease)
    with pytest.raises(CommandRejected) as rejected:
        harness.arm.go_to_joints(np.array([0, -0.7, 0, -2.3, 0, 1.6, 0.7]), lease)
    assert rejected.value.reason is Rejection.LEASE
    assert harness.truth()["energising"] == 0


def test_every_error_is_reported_by_the_table_and_cleared_only_on_request(harness: FrankaHarness) -> None:
    assert len(ERRORS) == len({error.name for error in ERRORS}) == 41
    harness.active()
    for code, error in enumerate(ERRORS):
        harness.emulator.fault("reflex", error.name)
        fault = faulted(harness)
        assert (fault.vendor_code, fault.name) == (code, error.name)
        assert (fault.fault_class, fault.needs, fault.hint) == (error.fault_class, error.needs, error.hint)
        assert harness.truth()["mode"] == "reflex"
        harness.arm.recover(OPERATOR)
        assert harness.arm.state is Lifecycle.READY
        assert harness.truth()["mode"] == "idle"
        harness.arm.activate()


def test_a_dead_motion_is_not_silent(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.send([0.03, 0, 0, 0, 0, 0], lease, 1.0)
    harness.moved()
    harness.emulator.fault("drop", 25)
    fault = faulted(harness)
    assert fault.name == "communication_constraints_violation"
    assert fault.fault_class is FaultClass.COMMUNICATION
    with pytest.raises(CommandRejected):
        harness.send([0.03, 0, 0, 0, 0, 0], lease)
    # Reading continues.
    assert harness.arm.tcp(0.5).value.twist[0] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("button", "name"), [("user_stop", "user stop"), ("locked", "joints locked")])
def test_stops_by_a_person_need_a_person(harness: FrankaHarness, button: str, name: str) -> None:
    lease = harness.active()
    harness.send([0.03, 0, 0, 0, 0, 0], lease, 1.0)
    harness.moved()
    harness.emulator.fault(button)
    fault = faulted(harness)
    assert fault.name.startswith(name)
    assert (fault.fault_class, fault.needs) == (FaultClass.SAFETY_STOP, Remedy.OPERATOR)
    with pytest.raises(DeviceFault, match=name):
        harness.arm.recover(OPERATOR)
    assert harness.arm.state is Lifecycle.FAULTED
    harness.emulator.clear(button)
    eventually(lambda: harness.arm.health()["mode"] == "Idle")
    harness.arm.recover(OPERATOR)
    assert harness.arm.state is Lifecycle.READY
    assert not harness.truth()["moving"]


def test_an_arm_that_is_locked_cannot_be_activated(harness: FrankaHarness) -> None:
    harness.emulator.fault("locked")
    harness.ready()
    with pytest.raises(DeviceFault, match="Desk"):
        harness.arm.activate()
    assert harness.arm.state is Lifecycle.FAULTED
    assert harness.truth()["energising"] == 0


def test_the_contact_backstop_stops_the_arm_and_stays(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.send_at_speed([0.05, 0, 0, 0, 0, 0], lease, 1.0)
    eventually(lambda: harness.truth()["twist"][0] > 0.049)
    before = harness.emulator.fault("external_wrench", [12, 0, 17, 0, 0, 0])["position_m"]
    fault = faulted(harness)
    assert fault.fault_class is FaultClass.CONTACT
    truth = harness.emulator.wait_for(moving=False)
    # By libfranka's thread: no reflex, and much less than the time-to-live was worth.
    assert truth["reflexes"] == 0
    assert truth["position_m"][0] - before[0] < 0.005
    np.testing.assert_allclose(harness.arm.wrench(1.0).value, [12, 0, 17, 0, 0, 0], atol=1e-5)
    with pytest.raises(DeviceFault, match="still in contact"):
        harness.arm.recover(OPERATOR)
    harness.emulator.clear("external_wrench")
    eventually(lambda: harness.arm.health()["external_force_n"] == 0.0)
    harness.arm.recover(OPERATOR)
    assert harness.arm.state is Lifecycle.READY


def test_a_torque_is_left_to_the_controller(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.send([0.02, 0, 0, 0, 0, 0], lease, 1.0)
    harness.moved()
    harness.emulator.fault("external_wrench", [0, 0, 0, 0, 0, 11])
    assert faulted(harness).name == "cartesian_reflex"


@pytest.mark.parametrize("moving", [False, True])
def test_a_few_bad_states_pass(harness: FrankaHarness, moving: bool) -> None:
    lease = harness.active()
    seen = [harness.arm.tcp().seq]
    for fault in ("nan", "out_of_order", "drop_states"):
        if moving:
            harness.send([0.02, 0, 0, 0, 0, 0], lease, 1.0)
            harness.moved()
        harness.emulator.fault(fault, 6)
        begin = seen[-1]
        while seen[-1] < begin + 30:
            sample = harness.arm.tcp(1.0)
            assert np.isfinite(sample.value.T_base_tcp).all()
            seen.append(sample.seq)
            harness.clock.sleep_until_ns(harness.clock.now_ns() + 1_000_000)
    assert seen == sorted(seen)
    assert harness.arm.state is Lifecycle.ACTIVE
    assert 1 <= harness.arm.health()["bad_states"] <= 6


def test_states_that_stay_bad_are_a_fault(harness: FrankaHarness) -> None:
    harness.active()
    harness.emulator.fault("nan", 1_000_000)
    until(StaleData, lambda: harness.arm.tcp(0.02))
    until(CorruptMessage, harness.arm.tcp)
    assert harness.arm.state is Lifecycle.FAULTED
    with pytest.raises(CorruptMessage):
        harness.arm.recover(OPERATOR)


def test_short_packets_are_counted_while_it_rests(harness: FrankaHarness) -> None:
    harness.active()
    harness.emulator.fault("corrupt", 3)
    eventually(lambda: harness.arm.health()["bad_states"] >= 1)
    assert harness.arm.tcp(1.0).seq > 0
    assert harness.arm.state is Lifecycle.ACTIVE


@pytest.mark.parametrize("fault", ["pause", "unplug"])
@pytest.mark.parametrize("moving", [False, True])
def test_a_silent_arm_is_stale_and_then_a_fault(harness: FrankaHarness, fault: str, moving: bool) -> None:
    lease = harness.active()
    if moving:
        harness.send([0.02, 0, 0, 0, 0, 0], lease, 1.0)
        harness.moved()
    harness.emulator.fault(fault)
    until(StaleData, lambda: harness.arm.tcp(0.3))
    until(TransportError, harness.arm.at_rest)
    assert harness.arm.state is Lifecycle.FAULTED
    assert not harness.arm.at_rest()
    if fault == "unplug":
        truth = harness.emulator.wait_for(moving=False)
        assert truth["mode"] == ("reflex" if moving else "idle")


def test_a_link_that_is_late_still_moves_it(harness: FrankaHarness) -> None:
    lease = harness.active()
    harness.emulator.fault("delay", 0.005)
    before = harness.position()
    harness.send_at_speed([0.05, 0, 0, 0, 0, 0], lease)
    harness.moved()
    harness.rested()
    assert harness.truth()["reflexes"] == 0
    assert_travel(harness.position() - before, np.array([1.0, 0.0, 0.0]))


def test_after_a_restart_it_connects_anew(harness: FrankaHarness) -> None:
    harness.active()
    harness.emulator.fault("restart")
    until(TransportError, harness.arm.tcp)
    harness.arm.disconnect()
    harness.active()
    assert harness.arm.tcp(1.0).value.T_base_tcp[0, 3] == pytest.approx(harness.position()[0], abs=1e-6)
