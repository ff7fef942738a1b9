"""The gate's limits: speed, acceleration and jerk by one factor for the whole twist, joints and singularities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.core.arm import JointLimitsConfig
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.gate import FIRST_STEP_S, TwistGate, TwistLimits
from touchcell.drivers.core.lease import LeaseManager
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain
from touchcell.drivers.kinematics.joint_limits import IkSettings
from touchcell.geometry.types import Array

LIMITS = TwistLimits(0.1, 0.5, 0.5, 2.5, 20.0, 100.0)
FREE = TwistLimits(10.0, 1e6, 10.0, 1e6, 1e12, 1e12)
DT_S = 0.004
CHAIN = SerialChain(ChainDescription.shipped("generic_6r"))
WORKING = np.deg2rad([10.0, 40.0, 90.0, 5.0, 50.0, 20.0])


class GateHarness:
    """A gate called once per ``DT_S``; ``q`` is the joint configuration, if it is to be used."""

    def __init__(self, limits: TwistLimits = LIMITS, ik: DifferentialIk | None = None) -> None:
        self.clock = VirtualClock(10**9)
        desk = LeaseManager("arm")
        self.gate = TwistGate("arm", limits, desk, self.clock)
        self.lease = desk.acquire("test")
        self.ik = ik
        self.q = WORKING.copy()

    def send(self, twist: Array, dt_s: float = DT_S) -> Sent[TwistCommand]:
        self.clock.advance_s(dt_s)
        command = TwistCommand(twist, TwistFrame.BASE, self.clock.now_ns(), 0.1)
        joints = (lambda: None) if self.ik is None else (lambda: self.ik.at(self.q))
        return self.gate.admit(command, self.lease, Lifecycle.ACTIVE, np.eye(4), joints=joints)


wanted = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array)


def norms(vector: Array) -> tuple[float, float]:
    return float(np.linalg.norm(vector[:3])), float(np.linalg.norm(vector[3:]))


@given(requested=st.lists(st.tuples(wanted, st.integers(1, 12)), min_size=1, max_size=6))
@settings(max_examples=60)
def test_speed_acceleration_and_jerk_limits_hold_for_any_command(requested: list[tuple[Array, int]]) -> None:
    harness = GateHarness()
    harness.send(np.zeros(6))
    last, accel = np.zeros(6), np.zeros(6)
    for twist, cycles in requested:
        for _ in range(cycles):
            sent = harness.send(twist).command.twist
            now = (sent - last) / DT_S
            jerk = (now - accel) / DT_S
            # Where the jerk limit carries the twist over the speed limit, the speed limit has priority.
            at_speed = norms(sent)[0] > 0.1 - 1e-9 or norms(sent)[1] > 0.5 - 1e-9
            for k, (most, most_accel, most_jerk) in enumerate(((0.1, 0.5, 20.0), (0.5, 2.5, 100.0))):
                assert norms(sent)[k] <= most * (1 + 1e-9)
                assert norms(now)[k] <= most_accel * (1 + 1e-9) or at_speed
                assert norms(jerk)[k] <= most_jerk * (1 + 1e-6) or at_speed
            last, accel = sent, now


@given(first=wanted, second=wanted)
@settings(max_examples=60)
def test_a_twist_that_stays_is_reached_exactly_and_stays(first: Array, second: Array) -> None:
    harness = GateHarness()
    for _ in range(20):
        harness.send(0.08 * first)
    target = np.concatenate([0.05 * second[:3], 0.25 * second[3:]])
    for _ in range(200):
        sent = harness.send(target)
    np.testing.assert_array_equal(sent.command.twist, target)
    assert not sent.limited


def test_from_rest_the_twist_keeps_its_direction_and_never_overshoots() -> None:
    harness = GateHarness()
    harness.send(np.zeros(6))
    target = np.array([0.06, -0.02, 0.0, 0.3, 0.0, -0.1])
    share = 0.0
    for _ in range(150):
        sent = harness.send(target).command.twist
        now = float(sent @ target / (target @ target))
        np.testing.assert_allclose(sent, now * target, atol=1e-12)
        assert share - 1e-12 <= now <= 1.0 + 1e-12
        share = now
    assert share == 1.0


def test_the_first_step_from_rest_is_the_jerks_and_is_named_with_value_and_limit() -> None:
    harness = GateHarness()
    harness.send(np.zeros(6))
    sent = harness.send(np.array([0.05, 0, 0, 0, 0, 0]))
    assert sent.command.twist[0] == pytest.approx(20.0 * DT_S**2)
    limits = {a.limit: (a.requested, a.allowed) for a in sent.adjustments}
    assert limits["tcp linear acceleration"] == (pytest.approx(0.05 / DT_S), 0.5)
    assert limits["tcp linear jerk"] == (pytest.approx(0.5 / DT_S), 20.0)
    assert set(limits) == {"tcp linear acceleration", "tcp linear jerk"}


def test_the_last_difference_before_the_target_is_removed_smoothly() -> None:
    harness = GateHarness()
    harness.send(np.zeros(6))
    accel = []
    last = 0.0
    while last < 0.05:
        now = harness.send(np.array([0.05, 0, 0, 0, 0, 0])).command.twist[0]
        accel.append((now - last) / DT_S)
        last = now
    assert max(accel) == pytest.approx(0.5)
    assert accel[-1] <= 20.0 * DT_S * (1 + 1e-9)


def test_after_a_silence_it_starts_from_rest() -> None:
    harness = GateHarness()
    for _ in range(100):
        harness.send(np.array([0.1, 0, 0, 0, 0, 0]))
    first = harness.send(np.array([0.1, 0, 0, 0, 0, 0]), dt_s=0.2).command.twist[0]
    assert first == pytest.approx(20.0 * FIRST_STEP_S**2)


def named(sent: Sent[TwistCommand]) -> set[str]:
    return {adjustment.limit for adjustment in sent.adjustments}


def test_each_part_of_a_ramp_names_the_limit_that_shapes_it_and_no_other() -> None:
    harness = GateHarness()
    harness.send(np.zeros(6))
    ramp = [named(harness.send(np.array([0.05, 0, 0, 0, 0, 0]))) for _ in range(60)]
    accelerating, jerking = {"tcp linear acceleration"}, {"tcp linear jerk"}
    # The jerk limits the first and the last 0.5 / 20 s, and between them the acceleration is constant.
    assert ramp[:6] == [accelerating | jerking] * 6
    assert ramp[6:24] == [accelerating] * 18
    assert ramp[24:28] == [accelerating | jerking] * 4
    assert ramp[28:30] == [jerking] * 2
    assert ramp[30:] == [set()] * 30


def test_an_acceleration_ends_within_the_jerk_limit_even_where_the_wanted_twist_is_reached_already() -> None:
    harness = GateHarness()
    harness.send(np.zeros(6))
    before, now = (harness.send(np.array([0.05, 0, 0, 0, 0, 0])).command.twist[0] for _ in range(13)), 0.0
    *_, last, now = before
    accel = (now - last) / DT_S
    assert accel == pytest.approx(0.5)
    sent = harness.send(np.array([now, 0, 0, 0, 0, 0]))
    assert (sent.command.twist[0] - now) / DT_S == pytest.approx(accel - 20.0 * DT_S)
    assert named(sent) == {"tcp linear jerk"}


@pytest.mark.parametrize(("late_ns", "first"), [(0, False), (1, True)])
def test_at_the_end_of_its_time_a_command_still_moves_the_arm_and_a_nanosecond_later_it_stands(
    late_ns: int, first: bool
) -> None:
    harness = GateHarness()
    forward = np.array([0.1, 0, 0, 0, 0, 0])
    for _ in range(100):
        harness.send(forward)
    harness.clock.advance_s(0.1 + 1e-9 * late_ns)
    command = TwistCommand(forward, TwistFrame.BASE, harness.clock.now_ns(), 0.1)
    sent = harness.gate.admit(command, harness.lease, Lifecycle.ACTIVE, np.eye(4))
    assert (sent.command.twist[0] < 0.01) == first


def test_a_limit_is_named_above_it_and_not_at_it() -> None:
    # Numbers that are exact in binary: from rest 0.5 m/s2 and 512 m/s3 for 2^-10 s, and 0.125 m/s.
    at_most = TwistLimits(0.125, 0.5, 0.5, 2.5, 512.0, 1e12)
    for speed, limits in ((2.0**-11, set()), (2.0**-10, {"tcp linear acceleration"})):
        harness = GateHarness(at_most)
        command = TwistCommand(np.array([speed, 0, 0, 0, 0, 0]), TwistFrame.BASE, 10**9, 2.0**-10)
        assert named(harness.gate.admit(command, harness.lease, Lifecycle.ACTIVE, np.eye(4))) == limits
    for linear, angular, limits in (
        (0.125, 0.5, set()),
        (0.126, 0.5, {"tcp linear speed"}),
        (0.125, 0.51, {"tcp angular speed"}),
    ):
        harness = GateHarness(at_most)
        for _ in range(100):
            sent = harness.send(np.array([linear, 0, 0, angular, 0, 0]))
        assert named(sent) == limits


@pytest.mark.parametrize("part", [0, 3])
def test_limits_of_zero_let_nothing_move_and_take_a_command_to_stand(part: int) -> None:
    speeds = {"speed_m_s": 0.0} if part == 0 else {"rot_speed_rad_s": 0.0}
    for limits in (TwistLimits(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), replace(LIMITS, **speeds)):
        for twist in (np.zeros(6), np.eye(6)[part], 10.0 * np.eye(6)[3 - part] + 0.0):
            harness = GateHarness(limits)
            for _ in range(5):
                sent = harness.send(twist)
            assert not sent.command.twist[part : part + 3].any()


def free_harness(**changes: float) -> GateHarness:
    return GateHarness(FREE, DifferentialIk(CHAIN, replace(IkSettings(), **changes)))


def test_a_joint_near_its_limit_slows_the_whole_twist_outwards_and_nothing_inwards() -> None:
    harness = free_harness()
    harness.q[5] = CHAIN.upper[5] - np.deg2rad(1.0)
    mixed = CHAIN.jacobian(harness.q) @ np.array([0.1, 0, 0, 0, 0, 1.0])
    for _ in range(100):
        sent = harness.send(mixed)
    share = (CHAIN.speed[5] / 5.0) / 1.0
    np.testing.assert_allclose(sent.command.twist, share * mixed, rtol=1e-9)
    (found,) = sent.adjustments
    assert (found.limit, found.requested, found.allowed) == ("joint tool", pytest.approx(1.0), pytest.approx(share))
    for _ in range(100):
        back = harness.send(-mixed)
    np.testing.assert_array_equal(back.command.twist, -mixed)


def test_beyond_a_joints_limit_only_the_way_back_is_open() -> None:
    harness = free_harness()
    harness.q[5] = CHAIN.upper[5] + 0.01
    outwards = CHAIN.jacobian(harness.q)[:, 5]
    assert not harness.send(outwards).command.twist.any()
    for _ in range(100):
        back = harness.send(-0.5 * outwards)
    np.testing.assert_array_equal(back.command.twist, -0.5 * outwards)


def test_joint_speed_and_acceleration_hold_for_the_whole_twist() -> None:
    harness = free_harness()
    fast = CHAIN.jacobian(harness.q) @ np.array([0.0, 4.0, 0, 0, 0, 0.5])
    harness.send(np.zeros(6))
    before = np.zeros(6)
    inverse = np.linalg.inv(CHAIN.jacobian(harness.q))
    for k in range(200):
        sent = harness.send(fast)
        dq = inverse @ sent.command.twist
        assert (np.abs(dq - before) <= CHAIN.accel * DT_S * (1 + 1e-9)).all()
        assert (np.abs(dq) <= CHAIN.speed * (1 + 1e-9)).all()
        if k == 0:
            limits = {a.limit: (a.requested, a.allowed) for a in sent.adjustments}
            assert limits == {
                "joint shoulder": (pytest.approx(4.0), pytest.approx(CHAIN.speed[1])),
                "joint shoulder acceleration": (pytest.approx(CHAIN.speed[1] / DT_S), pytest.approx(CHAIN.accel[1])),
            }
        before = dq
    np.testing.assert_allclose(sent.command.twist, CHAIN.speed[1] / 4.0 * fast, rtol=1e-9)


def test_a_singularity_is_approached_ever_slower_and_left() -> None:
    harness = free_harness()
    outwards = np.array([0.1, 0, 0, 0, 0, 0.0])
    for _ in range(3000):
        sent = harness.send(outwards)
        harness.q = harness.q + harness.ik.solve(harness.q, sent.command.twist).dq * DT_S
    at = harness.ik.solve(harness.q, np.zeros(6)).smallest_singular_value
    assert at == pytest.approx(0.02, abs=1e-3)
    assert np.linalg.norm(sent.command.twist) < 0.002
    assert any(a.limit == "singularity" for a in sent.adjustments)
    for _ in range(100):
        back = harness.send(-outwards)
    assert np.linalg.norm(back.command.twist) > 0.05


def test_below_the_floor_leaving_is_allowed_at_a_tenth_of_the_joint_speeds() -> None:
    # Almost straight up: nearly singular, and the elbow's bending leads out of it.
    q = np.deg2rad([0.0, 5.0, 2.0, 0.0, 40.0, 0.0])
    ik = DifferentialIk(CHAIN, JointLimitsConfig().settings(own_controller=True))
    assert ik.solve(q, np.zeros(6)).smallest_singular_value < 0.02
    leaving = CHAIN.jacobian(q) @ np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    motion = ik.solve(q, leaving)
    assert np.max(np.abs(motion.dq) / CHAIN.speed) == pytest.approx(0.1)
    np.testing.assert_allclose(motion.twist, motion.scale * leaving, atol=1e-9)
    assert motion.adjustments[-1].limit == "leaving a singularity"
    assert ik.solve(q, -leaving).scale == 0.0


def test_a_floor_above_the_threshold_is_refused() -> None:
    with pytest.raises(ValueError, match="singular_floor_mm 50 is not below"):
        JointLimitsConfig(singular_floor_mm=50.0)
