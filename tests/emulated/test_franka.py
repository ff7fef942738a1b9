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

from tests.helpers.franka_bench import OPERATOR, Bench, eventually
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
def benches() -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(**config: Any) -> Bench:
        made.append(Bench(**config))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


@pytest.fixture
def bench(benches: Callable[..., Bench]) -> Bench:
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


def faulted(bench: Bench) -> DeviceFault:
    """Wait until the driver has noticed, and return its fault."""
    fault = until(DeviceFault, bench.arm.tcp)
    assert bench.arm.state is Lifecycle.FAULTED
    assert bench.arm.fault is fault
    return fault


def test_its_spec_needs_no_sdk() -> None:
    code = "from touchcell.drivers.core.spec import DRIVERS; DRIVERS.load('franka')"
    code += "; import sys; assert 'franky' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert DRIVERS.load("franka").extra == "franka"


def test_a_missing_sdk_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "franky", None)
    arm = DRIVERS.load("franka").build(
        "arm", FrankaConfig(host="127.0.0.1", enforce_realtime=False), DriverContext(MonotonicClock())
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


def test_connecting_configuring_and_activating_energise_nothing(bench: Bench) -> None:
    own = os.sched_getscheduler(0)
    bench.ready()
    truth = bench.truth()
    assert truth["energising"] == 0
    assert set(truth["received"]) == {"connect", "get_robot_model", "set_collision_behavior"}
    assert truth["force_threshold"] == [40, 40, 40, 10, 10, 10]
    bench.arm.activate()
    assert bench.truth()["energising"] == 0
    assert bench.arm.health()["mode"] == "Idle"
    assert os.sched_getscheduler(0) == own


def test_it_has_its_declared_capabilities(bench: Bench) -> None:
    for protocol in CAPABILITIES.provides:
        assert isinstance(bench.arm, protocol), protocol
    assert bench.arm.watchdog_s() == bench.truth()["watchdog_s"] == CAPABILITIES.max_watchdog_s


def test_an_unreachable_controller_is_a_connect_error(bench: Bench) -> None:
    bench.emulator.kill()
    with pytest.raises(ConnectError):
        bench.arm.connect()
    assert bench.arm.state is Lifecycle.DISCONNECTED


def test_a_second_owner_is_turned_away(bench: Bench) -> None:
    lease = bench.active()
    other = bench.another()
    with pytest.raises(ConnectError, match="one only"):
        other.connect()
    bench.send([0.02, 0, 0, 0, 0, 0], lease)
    bench.moved()


@pytest.mark.skipif(Path("/sys/kernel/realtime").exists(), reason="this kernel is a real-time one")
@pytest.mark.skipif(Path("/sys/kernel/realtime").exists(), reason="this kernel is a real-time one")
def test_a_missing_realtime_kernel_is_found_before_connecting(benches: Callable[..., Bench]) -> None:
    bench = benches(enforce_realtime=True)
    with pytest.raises(ConnectError, match="enforce_realtime: false"):
        bench.arm.connect()
    assert bench.truth()["requests"] == 0


def test_pose_and_joints_are_true(benches: Callable[..., Bench]) -> None:
    bench = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    bench.ready()
    truth = bench.truth()
    np.testing.assert_allclose(truth["F_T_EE"], se3.from_euler_mm_deg(TOOL_MM_DEG), atol=1e-7)
    np.testing.assert_allclose(bench.arm.tcp(1.0).value.T_base_tcp, truth["T_base_ee"], atol=1e-6)
    np.testing.assert_allclose(bench.arm.joints(1.0).value.q, truth["q"], atol=1e-6)


def test_a_pure_rotation_keeps_the_tool_centre_point_in_place(benches: Callable[..., Bench]) -> None:
    bench = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    lease = bench.active()
    T_before = np.array(bench.truth()["T_base_ee"])
    bench.send([0, 0, 0, 0.1, -0.2, 0.05], lease, 0.5)
    bench.moved()
    eventually(lambda: np.linalg.norm(bench.arm.tcp().value.twist[3:]) > 0.2)
    np.testing.assert_allclose(bench.arm.tcp().value.twist[:3], 0, atol=1e-4)
    bench.rested()
    T_after = np.array(bench.truth()["T_base_ee"])
    np.testing.assert_allclose(T_after[:3, 3], T_before[:3, 3], atol=5e-5)
    turn = se3.log(T_after @ se3.inverse(T_before))[3:]
    np.testing.assert_allclose(turn / np.linalg.norm(turn), np.array([0.1, -0.2, 0.05]) / 0.2291288, atol=1e-3)


def test_a_twist_along_tool_axes_moves_along_the_tool(benches: Callable[..., Bench]) -> None:
    bench = benches(flange_to_tcp_mm_deg=TOOL_MM_DEG)
    lease = bench.active()
    T_before = np.array(bench.truth()["T_base_ee"])
    bench.send([0, 0, 0.05, 0, 0, 0], lease, frame=TwistFrame.TCP)
    bench.moved()
    bench.rested()
    moved = bench.position() - T_before[:3, 3]
    np.testing.assert_allclose(moved, TTL_DISTANCE_M * T_before[:3, 2], atol=1e-4)


def test_the_time_to_live_ends_the_motion_while_python_hangs(bench: Bench) -> None:
    lease = bench.active()
    before = bench.position()
    bench.send([0.05, 0, 0, 0, 0, 0], lease)
    # A C call that keeps the interpreter lock: no Python thread of this process can do anything meanwhile.
    ctypes.PyDLL(None).usleep(700_000)
    truth = bench.truth()
    assert not truth["moving"]
    assert truth["mode"] == "idle"
    np.testing.assert_allclose(np.array(truth["position_m"]) - before, [TTL_DISTANCE_M, 0, 0], atol=1e-4)


CLIENT = """
import sys, time
import numpy as np
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.franka.driver import FrankaArm, FrankaConfig
clock = MonotonicClock()
arm = FrankaArm("arm", FrankaConfig(host=sys.argv[1], enforce_realtime=False), clock)
arm.connect(); arm.configure(); arm.activate()
lease = arm.acquire("child")
while True:
    arm.send_twist(TwistCommand(np.array([0.05, 0, 0, 0, 0, 0]), TwistFrame.BASE, clock.now_ns(), 0.5), lease)
    time.sleep(0.02)
"""


@pytest.mark.parametrize("death", [signal.SIGKILL, signal.SIGSTOP])
def test_the_arm_stops_when_its_client_is_killed_or_frozen(bench: Bench, death: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", CLIENT, bench.config.host]) as client:
        try:
            eventually(lambda: bench.truth()["twist"][0] > 0.049)
            client.send_signal(death)
            truth = bench.emulator.wait_for(moving=False)
        finally:
            client.kill()
    assert truth["last_errors"] == ["communication_constraints_violation"]
    overrun = np.linalg.norm(np.array(truth["position_m"]) - truth["at_last_command_m"])
    # Twenty packets at 0.05 m/s, and the one that was answered.
    assert overrun <= 0.05 * 0.0211


def test_a_stream_at_50_hz_is_followed_without_reflex(bench: Bench) -> None:
    lease = bench.active()
    before = bench.position()
    for step in range(50):
        bench.send([0.03 * np.sin(2 * np.pi * step / 50), 0.02, 0, 0, 0, 0.1], lease)
        bench.clock.sleep_until_ns(bench.clock.now_ns() + 20_000_000)
    bench.rested()
    truth = bench.truth()
    assert truth["reflexes"] == 0
    assert truth["received"]["move"] <= 3
    moved = np.array(truth["position_m"]) - before
    assert moved[1] > 0.01
    assert abs(moved[2]) < 1e-4


def test_stop_ends_a_motion_and_keeps_the_lease(bench: Bench) -> None:
    lease = bench.active()
    bench.send([0.05, 0, 0, 0, 0, 0], lease, 1.0)
    bench.moved()
    bench.arm.stop()
    bench.rested()
    assert bench.arm.state is Lifecycle.ACTIVE
    assert bench.truth()["reflexes"] == 0
    bench.send([0.02, 0, 0, 0, 0, 0], lease)
    bench.moved()


def test_disconnecting_stops_first(bench: Bench) -> None:
    lease = bench.active()
    bench.send([0.05, 0, 0, 0, 0, 0], lease, 1.0)
    bench.moved()
    bench.arm.disconnect()
    truth = bench.emulator.wait_for(connected=False)
    assert (truth["moving"], truth["reflexes"], truth["mode"]) == (False, 0, "idle")


def test_only_holding_is_offered_when_it_is_deactivated(bench: Bench) -> None:
    bench.active()
    with pytest.raises(LifecycleError, match="brakes"):
        bench.arm.deactivate(DeactivatePolicy.BRAKE)
    bench.arm.deactivate(DeactivatePolicy.HOLD)
    assert bench.arm.state is Lifecycle.READY


def test_joint_goals_arrive(bench: Bench) -> None:
    lease = bench.active()
    goal = np.array([0.05, -0.75, 0.05, -2.3, 0.05, 1.6, 0.75])
    bench.arm.go_to_joints(goal, lease, speed_fraction=1.0)
    assert not bench.arm.at_rest()
    with pytest.raises(CommandRejected) as rejected:
        bench.send([0.02, 0, 0, 0, 0, 0], lease)
    assert rejected.value.reason is Rejection.MODE
    bench.rested()
    np.testing.assert_allclose(bench.truth()["q"], goal, atol=1e-6)


def test_a_goal_that_was_aborted_does_not_look_reached(bench: Bench) -> None:
    lease = bench.active()
    bench.arm.go_to_joints(np.array([0.3, -0.75, 0.05, -2.3, 0.05, 1.6, 0.75]), lease)
    bench.moved()
    bench.emulator.fault("reflex", "joint_reflex")
    assert until(DeviceFault, bench.rested).name == "joint_reflex"


def test_pose_goals_arrive_and_keep_the_speed_limit(benches: Callable[..., Bench]) -> None:
    bench = benches(dynamics_factor=0.3, limits={"tcp_speed_m_s": 0.05})
    lease = bench.active()
    goal = bench.arm.tcp().value.T_base_tcp @ se3.from_euler_mm_deg([10, -20, 5, 2, -3, 4])
    bench.arm.go_to_pose(goal, lease, speed_fraction=1.0)
    fastest = 0.0
    while not bench.arm.at_rest():
        fastest = max(fastest, float(np.linalg.norm(bench.truth()["twist"][:3])))
    np.testing.assert_allclose(bench.truth()["T_base_ee"], goal, atol=1e-5)
    assert 0.02 < fastest < 0.0501


def test_impossible_joint_goals_are_refused(bench: Bench) -> None:
    lease = bench.active()
    goals = [
        (np.full(7, np.nan), Rejection.NON_FINITE),
        (np.zeros(6), Rejection.SHAPE),
        (np.array([0, 0, 0, 0.5, 0, 1.5, 0]), Rejection.LIMIT),
    ]
    for goal, reason in goals:
        with pytest.raises(CommandRejected) as rejected:
            bench.arm.go_to_joints(goal, lease)
        assert rejected.value.reason is reason
    bench.arm.release(lease)
    with pytest.raises(CommandRejected) as rejected:
        bench.arm.go_to_joints(np.array([0, -0.7, 0, -2.3, 0, 1.6, 0.7]), lease)
    assert rejected.value.reason is Rejection.LEASE
    assert bench.truth()["energising"] == 0


def test_every_error_is_reported_by_the_table_and_cleared_only_on_request(bench: Bench) -> None:
    assert len(ERRORS) == len({error.name for error in ERRORS}) == 41
    bench.active()
    for code, error in enumerate(ERRORS):
        bench.emulator.fault("reflex", error.name)
        fault = faulted(bench)
        assert (fault.vendor_code, fault.name) == (code, error.name)
        assert (fault.fault_class, fault.needs, fault.hint) == (error.fault_class, error.needs, error.hint)
        assert bench.truth()["mode"] == "reflex"
        bench.arm.recover(OPERATOR)
        assert bench.arm.state is Lifecycle.READY
        assert bench.truth()["mode"] == "idle"
        bench.arm.activate()


def test_a_dead_motion_is_not_silent(bench: Bench) -> None:
    lease = bench.active()
    bench.send([0.03, 0, 0, 0, 0, 0], lease, 1.0)
    bench.moved()
    bench.emulator.fault("drop", 25)
    fault = faulted(bench)
    assert fault.name == "communication_constraints_violation"
    assert fault.fault_class is FaultClass.COMMUNICATION
    with pytest.raises(CommandRejected):
        bench.send([0.03, 0, 0, 0, 0, 0], lease)
    # Reading continues.
    assert bench.arm.tcp(0.5).value.twist[0] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("button", "name"), [("user_stop", "user stop"), ("locked", "joints locked")])
def test_stops_by_a_person_need_a_person(bench: Bench, button: str, name: str) -> None:
    lease = bench.active()
    bench.send([0.03, 0, 0, 0, 0, 0], lease, 1.0)
    bench.moved()
    bench.emulator.fault(button)
    fault = faulted(bench)
    assert fault.name.startswith(name)
    assert (fault.fault_class, fault.needs) == (FaultClass.SAFETY_STOP, Remedy.OPERATOR)
    with pytest.raises(DeviceFault, match=name):
        bench.arm.recover(OPERATOR)
    assert bench.arm.state is Lifecycle.FAULTED
    bench.emulator.clear(button)
    eventually(lambda: bench.arm.health()["mode"] == "Idle")
    bench.arm.recover(OPERATOR)
    assert bench.arm.state is Lifecycle.READY
    assert not bench.truth()["moving"]


def test_an_arm_that_is_locked_cannot_be_activated(bench: Bench) -> None:
    bench.emulator.fault("locked")
    bench.ready()
    with pytest.raises(DeviceFault, match="Desk"):
        bench.arm.activate()
    assert bench.arm.state is Lifecycle.FAULTED
    assert bench.truth()["energising"] == 0


def test_the_contact_backstop_stops_the_arm_and_stays(bench: Bench) -> None:
    lease = bench.active()
    bench.send([0.05, 0, 0, 0, 0, 0], lease, 1.0)
    eventually(lambda: bench.truth()["twist"][0] > 0.049)
    before = bench.emulator.fault("external_wrench", [12, 0, 17, 0, 0, 0])["position_m"]
    fault = faulted(bench)
    assert fault.fault_class is FaultClass.CONTACT
    truth = bench.emulator.wait_for(moving=False)
    # By libfranka's thread: no reflex, and much less than the time-to-live was worth.
    assert truth["reflexes"] == 0
    assert truth["position_m"][0] - before[0] < 0.005
    np.testing.assert_allclose(bench.arm.wrench(1.0).value, [12, 0, 17, 0, 0, 0], atol=1e-5)
    with pytest.raises(DeviceFault, match="still in contact"):
        bench.arm.recover(OPERATOR)
    bench.emulator.clear("external_wrench")
    eventually(lambda: bench.arm.health()["external_force_n"] == 0.0)
    bench.arm.recover(OPERATOR)
    assert bench.arm.state is Lifecycle.READY


def test_a_torque_is_left_to_the_controller(bench: Bench) -> None:
    lease = bench.active()
    bench.send([0.02, 0, 0, 0, 0, 0], lease, 1.0)
    bench.moved()
    bench.emulator.fault("external_wrench", [0, 0, 0, 0, 0, 11])
    assert faulted(bench).name == "cartesian_reflex"


@pytest.mark.parametrize("moving", [False, True])
def test_a_few_bad_states_pass(bench: Bench, moving: bool) -> None:
    lease = bench.active()
    seen = [bench.arm.tcp().seq]
    for fault in ("nan", "out_of_order", "drop_states"):
        if moving:
            bench.send([0.02, 0, 0, 0, 0, 0], lease, 1.0)
            bench.moved()
        bench.emulator.fault(fault, 6)
        begin = seen[-1]
        while seen[-1] < begin + 30:
            sample = bench.arm.tcp(1.0)
            assert np.isfinite(sample.value.T_base_tcp).all()
            seen.append(sample.seq)
            bench.clock.sleep_until_ns(bench.clock.now_ns() + 1_000_000)
    assert seen == sorted(seen)
    assert bench.arm.state is Lifecycle.ACTIVE
    assert 1 <= bench.arm.health()["bad_states"] <= 6


def test_states_that_stay_bad_are_a_fault(bench: Bench) -> None:
    bench.active()
    bench.emulator.fault("nan", 1_000_000)
    until(StaleData, lambda: bench.arm.tcp(0.02))
    until(CorruptMessage, bench.arm.tcp)
    assert bench.arm.state is Lifecycle.FAULTED
    with pytest.raises(CorruptMessage):
        bench.arm.recover(OPERATOR)


def test_short_packets_are_counted_while_it_rests(bench: Bench) -> None:
    bench.active()
    bench.emulator.fault("corrupt", 3)
    eventually(lambda: bench.arm.health()["bad_states"] >= 1)
    assert bench.arm.tcp(1.0).seq > 0
    assert bench.arm.state is Lifecycle.ACTIVE


@pytest.mark.parametrize("fault", ["pause", "unplug"])
@pytest.mark.parametrize("moving", [False, True])
def test_a_silent_arm_is_stale_and_then_a_fault(bench: Bench, fault: str, moving: bool) -> None:
    lease = bench.active()
    if moving:
        bench.send([0.02, 0, 0, 0, 0, 0], lease, 1.0)
        bench.moved()
    bench.emulator.fault(fault)
    until(StaleData, lambda: bench.arm.tcp(0.3))
    until(TransportError, bench.arm.at_rest)
    assert bench.arm.state is Lifecycle.FAULTED
    assert not bench.arm.at_rest()
    if fault == "unplug":
        truth = bench.emulator.wait_for(moving=False)
        assert truth["mode"] == ("reflex" if moving else "idle")


def test_a_link_that_is_late_still_moves_it(bench: Bench) -> None:
    lease = bench.active()
    bench.emulator.fault("delay", 0.005)
    before = bench.position()
    bench.send([0.05, 0, 0, 0, 0, 0], lease)
    bench.moved()
    bench.rested()
    assert bench.truth()["reflexes"] == 0
    assert (bench.position() - before)[0] == pytest.approx(TTL_DISTANCE_M, abs=2e-4)


def test_after_a_restart_it_connects_anew(bench: Bench) -> None:
    bench.active()
    bench.emulator.fault("restart")
    until(TransportError, bench.arm.tcp)
    bench.arm.disconnect()
    bench.active()
    assert bench.arm.tcp(1.0).value.T_base_tcp[0, 3] == pytest.approx(bench.position()[0], abs=1e-6)
