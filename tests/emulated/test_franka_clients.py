"""Validate the Franka emulator with independent clients: franky, and libfranka's own Python bindings."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from tests.helpers.franka_harness import DEADLINE_S, eventually, fresh_host
from touchcell.drivers.franka.emulator.arm import JOINT_MAX_RAD, JOINT_MIN_RAD, READY_POSE_RAD, flange_pose
from touchcell.drivers.franka.errors import ERRORS
from touchcell.drivers.franka.rig import PATIENCE_S
from touchcell.testing.emulation.process import EmulatorProcess

franky = pytest.importorskip("franky")

FACTOR = 0.2
# libfranka's filter takes every call for a millisecond: on a busy machine positions would jump after a late one.
NO_FILTER_HZ = 1000.0


class Emulated:
    def __init__(self, *arguments: str) -> None:
        self.host = fresh_host()
        self.process = EmulatorProcess("franka", "--host", self.host, *arguments, timeout_s=DEADLINE_S).start()


@pytest.fixture
def emulated() -> Iterator[Emulated]:
    # Without patience a client that a busy machine starves for some milliseconds would be stopped by a reflex.
    one = Emulated("--patience", str(PATIENCE_S))
    yield one
    one.process.stop()


@pytest.fixture
def robot(emulated: Emulated) -> franky.Robot:
    return franky.Robot(emulated.host, relative_dynamics_factor=FACTOR, realtime_config=franky.RealtimeConfig.Ignore)


def test_libfrankas_kinematics_agree(emulated: Emulated, robot: franky.Robot) -> None:
    """libfranka computes poses from our URDF by itself; the emulator from Denavit-Hartenberg parameters."""
    state = robot.state
    generator = np.random.default_rng(3)
    for _ in range(20):
        q = generator.uniform(JOINT_MIN_RAD, JOINT_MAX_RAD)
        theirs = robot.model.pose(franky.Frame.Flange, q, state.F_T_EE, state.EE_T_K).matrix
        np.testing.assert_allclose(theirs, flange_pose(q)[0], atol=1e-9)


def test_franky_moves_it_by_every_generator(emulated: Emulated, robot: franky.Robot) -> None:
    def truth(name: str) -> np.ndarray:
        return np.array(emulated.process.state()[name])

    before = truth("position_m")
    twist = franky.Twist([0.05, 0, -0.02], [0, 0, 0.1])
    robot.move(franky.CartesianVelocityMotion(twist, duration=franky.Duration(400)))
    moved = truth("position_m") - before
    assert moved[0] == pytest.approx(0.02, abs=1e-4)
    assert moved[2] == pytest.approx(-0.008, abs=1e-4)
    goal = robot.current_pose.end_effector_pose.matrix
    goal[:3, 3] += [0.01, -0.02, 0.0]
    robot.move(franky.CartesianMotion(franky.Affine(goal)), cutoff_frequency=NO_FILTER_HZ)
    np.testing.assert_allclose(truth("T_base_ee"), goal, atol=1e-5)
    q = READY_POSE_RAD + 0.05
    robot.move(franky.JointMotion(franky.JointState(q)), cutoff_frequency=NO_FILTER_HZ)
    np.testing.assert_allclose(truth("q"), q, atol=1e-6)
    robot.move(franky.JointVelocityMotion([0.1, 0, 0, 0, 0, 0, 0], duration=franky.Duration(300)))
    assert truth("q")[0] == pytest.approx(q[0] + 0.03, abs=1e-3)
    assert emulated.process.state()["reflexes"] == 0


def test_franky_reports_reflexes_and_recovers(emulated: Emulated, robot: franky.Robot) -> None:
    robot.move(
        franky.CartesianVelocityMotion(franky.Twist([0.03, 0, 0]), duration=franky.Duration(2000)), asynchronous=True
    )
    emulated.process.wait_for(moving=True)
    emulated.process.fault("external_wrench", [35, 0, 0, 0, 0, 0])
    with pytest.raises(franky.ControlException, match="cartesian_reflex"):
        robot.join_motion()
    assert robot.has_errors
    assert robot.state.robot_mode == franky.RobotMode.Reflex
    assert robot.state.O_F_ext_hat_K[0] == pytest.approx(-35)
    emulated.process.clear("external_wrench")
    eventually(lambda: abs(robot.state.O_F_ext_hat_K[0]) < 1.0)
    assert robot.recover_from_errors()
    assert robot.state.robot_mode == franky.RobotMode.Idle
    robot.move(franky.CartesianVelocityMotion(franky.Twist([0.03, 0, 0]), duration=franky.Duration(100)))


def test_franky_at_full_speed_breaks_the_fr3s_jerk_limit(emulated: Emulated, robot: franky.Robot) -> None:
    robot.relative_dynamics_factor = 1.0
    motion = franky.JointMotion(franky.JointState(READY_POSE_RAD + 0.2))
    with pytest.raises(franky.ControlException, match=r"joint_motion_generator_(acceleration|velocity)_discontinuity"):
        robot.move(motion)


def test_franky_loses_20_packets(emulated: Emulated, robot: franky.Robot) -> None:
    motion = franky.CartesianVelocityMotion(franky.Twist([0.03, 0, 0]), duration=franky.Duration(2000))
    robot.move(motion, asynchronous=True)
    emulated.process.wait_for(moving=True)
    emulated.process.fault("drop", 15)
    eventually(lambda: "drop" not in emulated.process.state()["active"])
    assert robot.is_in_control
    emulated.process.fault("drop", 25)
    with pytest.raises(franky.ControlException, match="communication_constraints_violation"):
        robot.join_motion()


def test_franky_is_refused_while_another_client_is_connected(emulated: Emulated, robot: franky.Robot) -> None:
    with pytest.raises(franky.NetworkException):
        franky.Robot(emulated.host, realtime_config=franky.RealtimeConfig.Ignore)


def test_impedance_motions_move_the_arm_and_can_be_stopped(emulated: Emulated) -> None:
    robot = franky.Robot(emulated.host, relative_dynamics_factor=FACTOR, realtime_config=franky.RealtimeConfig.Ignore)
    goal = robot.current_pose.end_effector_pose.matrix
    goal[0, 3] += 0.02
    robot.move(franky.CartesianImpedanceMotion(franky.Affine(goal)), asynchronous=True)
    eventually(lambda: abs(emulated.process.state()["position_m"][0] - goal[0, 3]) < 1e-3)
    assert emulated.process.state()["mode"] == "move"
    robot.move(franky.TorqueStopMotion(), asynchronous=True)
    robot.join_motion()
    state = emulated.process.state()
    assert (state["mode"], state["reflexes"]) == ("idle", 0)


def test_an_impedance_motion_gives_way_to_a_push(emulated: Emulated) -> None:
    robot = franky.Robot(emulated.host, relative_dynamics_factor=FACTOR, realtime_config=franky.RealtimeConfig.Ignore)
    start = emulated.process.state()["position_m"][1]
    here = franky.Affine(robot.current_pose.end_effector_pose.matrix)
    robot.move(franky.CartesianImpedanceMotion(here, translational_stiffness=500), asynchronous=True)
    emulated.process.wait_for(mode="move")
    emulated.process.fault("external_wrench", [0, 10, 0, 0, 0, 0])
    eventually(lambda: emulated.process.state()["position_m"][1] - start > 0.015)
    emulated.process.clear("external_wrench")
    eventually(lambda: abs(emulated.process.state()["position_m"][1] - start) < 2e-3)
    robot.move(franky.TorqueStopMotion(), asynchronous=True)
    robot.join_motion()


def test_franky_homes_moves_and_grasps_with_the_hand(emulated: Emulated) -> None:
    hand = franky.Gripper(emulated.host)
    assert (hand.server_version, hand.max_width) == (3, 0.08)
    assert hand.homing()
    assert hand.move(0.06, 0.1)
    assert emulated.process.state()["hand_width_m"] == pytest.approx(0.06)
    emulated.process.fault("object", 0.03)
    assert hand.grasp(0.03, 0.1, 20.0, 0.005, 0.005)
    assert (hand.is_grasped, hand.width) == (True, 0.03)
    assert hand.open(0.1)
    assert not hand.grasp(0.06, 0.1, 20.0, 0.005, 0.005)
    assert not hand.move(0.01, 0.1)
    with pytest.raises(franky.CommandException, match="failed"):
        hand.move(0.2, 0.1)
    opening = hand.move_async(0.08, 0.01)
    eventually(lambda: emulated.process.state()["hand_width_m"] > 0.031)
    assert hand.stop()
    with pytest.raises(franky.CommandException, match="aborted"):
        opening.get()


def test_a_missing_hand_refuses(emulated: Emulated) -> None:
    emulated.process.fault("no_hand")
    with pytest.raises(franky.NetworkException):
        franky.Gripper(emulated.host)


# pylibfranka and franky cannot live in one process: both register the same pybind11 types.
LIBFRANKA = """
import json, math, sys
import pylibfranka as pf
from touchcell.testing.emulation.process import EmulatorProcess
host, names = sys.argv[1], json.loads(sys.argv[2])
with EmulatorProcess("franka", "--host", host, timeout_s=20.0) as emulator:
    robot = pf.Robot(host, pf.RealtimeConfig.kIgnore)
    seen = []
    for name in names:
        emulator.fault("reflex", name)
        while not (state := robot.read_once()).current_errors:
            pass
        seen.append([n for n in dir(state.current_errors) if getattr(state.current_errors, n) is True])
        robot.automatic_error_recovery()
    before = emulator.state()["position_m"]
    control = robot.start_cartesian_velocity_control(pf.ControllerMode.JointImpedance)
    t = 0.0
    while t < 0.5:
        state, period = control.readOnce()
        t += period.to_sec()
        command = pf.CartesianVelocities([0.05 * math.sin(math.pi * t / 0.5) ** 2, 0, 0, 0, 0, 0])
        command.motion_finished = t >= 0.5
        control.writeOnce(command)
    emulator.wait_for(mode="idle")
    after = emulator.state()["position_m"]
    print(json.dumps({"seen": seen, "moved": [b - a for a, b in zip(before, after)]}))
"""


def test_libfranka_names_every_error_and_closes_a_loop_in_python() -> None:
    pytest.importorskip("importlib.util").find_spec("pylibfranka") or pytest.skip("pylibfranka is not installed")
    names = [error.name for error in ERRORS]
    done = subprocess.run(
        [sys.executable, "-c", LIBFRANKA, fresh_host(), json.dumps(names)], capture_output=True, text=True, check=True
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["seen"] == [[name] for name in names]
    # The mean of sin² is a half.
    np.testing.assert_allclose(result["moved"], [0.5 * 0.05 * 0.5, 0, 0], atol=1e-4)
