"""Torque control of the emulated Franka arm, stepped by hand."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.drivers.franka.emulator.arm import EmulatedArm, Reflex
from touchcell.drivers.franka.emulator.codec import Generator, MotionCommand

NO_MOTION = MotionCommand(
    0, (0.0,) * 7, (0.0,) * 7, (0.0,) * 16, (0.0,) * 6, (0.0,) * 2, False, False, (0.0,) * 7, False
)


def torques(message_id: int, *tau: float) -> MotionCommand:
    return NO_MOTION._replace(message_id=message_id, tau=(*tau, *[0.0] * (7 - len(tau))))


@pytest.fixture
def arm() -> EmulatedArm:
    made = EmulatedArm()
    assert made.begin(Generator.NONE, 0, by_torque=True)
    return made


def test_without_torque_gravity_is_compensated_and_the_arm_stands(arm: EmulatedArm) -> None:
    q = arm.q.copy()
    for k in range(100):
        arm.step(torques(k + 1), 1e-3)
    np.testing.assert_array_equal(arm.q, q)


def test_a_joint_turns_the_way_of_its_torque(arm: EmulatedArm) -> None:
    q = arm.q.copy()
    for k in range(200):
        arm.step(torques(k + 1, min(k, 5.0)), 1e-3)
    assert arm.q[0] > q[0] + 0.01
    np.testing.assert_array_equal(arm.q[1:], q[1:])


def test_a_push_turns_the_joints_as_its_work_requires(arm: EmulatedArm) -> None:
    start = arm.T_base_ee[:3, 3].copy()
    arm.wrench = np.array([5.0, 0, 0, 0, 0, 0])
    for k in range(200):
        arm.step(torques(k + 1), 1e-3)
    assert arm.T_base_ee[0, 3] > start[0] + 1e-3


@pytest.mark.parametrize(
    ("command", "error"),
    [
        (torques(1, 5.0), "controller_torque_discontinuity"),
        (torques(1, 100.0), "tau_j_range_violation"),
        (torques(1, float("nan")), "communication_constraints_violation"),
    ],
)
def test_torques_that_a_controller_refuses_are_a_reflex(arm: EmulatedArm, command: MotionCommand, error: str) -> None:
    with pytest.raises(Reflex) as reflex:
        arm.step(command, 1e-3)
    assert reflex.value.name == error


def test_after_lost_packets_a_torque_may_have_changed_by_more(arm: EmulatedArm) -> None:
    arm.step(torques(6, 5.0), 1e-3)
    assert arm.tau[0] == 5.0
