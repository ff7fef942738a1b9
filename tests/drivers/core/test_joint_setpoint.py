from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.joint_setpoint import JointSetpoint
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain

CHAIN = SerialChain(ChainDescription.shipped("generic_6r"))
LIMITS = LimitsConfig().build()
WORKING = np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0])
DT_S = 0.004
DT_NS = 4_000_000


def standing() -> JointSetpoint:
    setpoint = JointSetpoint(CHAIN, DifferentialIk(CHAIN), LIMITS)
    setpoint.reset(WORKING)
    return setpoint


def test_a_twist_moves_the_tool_along_and_its_end_brings_it_to_rest() -> None:
    setpoint = standing()
    start = CHAIN.forward(setpoint.q)
    setpoint.follow(np.array([0.05, 0.0, 0.02, 0.0, 0.0, 0.0]), 500 * DT_NS)
    for k in range(500):
        setpoint.step(k * DT_NS, DT_S)
    moved = CHAIN.forward(setpoint.q)[:3, 3] - start[:3, 3]
    # 2 s at speed, less half of the time that it takes to get there.
    speed_m_s = np.hypot(0.05, 0.02)
    np.testing.assert_allclose(moved, np.array([0.05, 0.0, 0.02]) * (2.0 - speed_m_s / 0.5 / 2), atol=3e-4)
    for k in range(500, 500 + 28):
        setpoint.step(k * DT_NS, DT_S)
    assert not setpoint.moving
    stopped_at = setpoint.q.copy()
    braking = CHAIN.forward(setpoint.q)[:3, 3] - start[:3, 3] - moved
    assert np.linalg.norm(braking) == pytest.approx(speed_m_s**2 / (2 * 0.5), rel=0.1)
    for k in range(528, 600):
        setpoint.step(k * DT_NS, DT_S)
    np.testing.assert_array_equal(setpoint.q, stopped_at)


def test_a_joint_goal_is_reached_exactly_and_at_rest() -> None:
    setpoint = standing()
    goal = np.deg2rad([20.0, 10.0, 70.0, -30.0, 40.0, 60.0])
    setpoint.go_to(goal, 0.5)
    for k in range(5000):
        setpoint.step(k * DT_NS, DT_S)
        if not setpoint.moving:
            break
    np.testing.assert_allclose(setpoint.q, goal, atol=1e-9)
    assert not setpoint.dq.any()


def test_a_stop_on_the_way_to_a_goal_forgets_the_goal() -> None:
    setpoint = standing()
    setpoint.go_to(np.deg2rad([60.0, 10.0, 70.0, -30.0, 40.0, 60.0]), 1.0)
    for k in range(150):
        setpoint.step(k * DT_NS, DT_S)
    assert setpoint.dq.any()
    setpoint.stop()
    for k in range(150, 250):
        setpoint.step(k * DT_NS, DT_S)
    assert not setpoint.moving
    rest = setpoint.q.copy()
    setpoint.step(251 * DT_NS, DT_S)
    np.testing.assert_array_equal(setpoint.q, rest)


def test_motion_held_back_by_a_limit_turns_back_at_once() -> None:
    setpoint = standing()
    outwards = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    for k in range(2000):
        setpoint.follow(outwards, (k + 2) * DT_NS)
        setpoint.step(k * DT_NS, DT_S)
    assert setpoint.adjustments
    before = CHAIN.forward(setpoint.q)[0, 3]
    for k in range(2000, 2010):
        setpoint.follow(-outwards, (k + 2) * DT_NS)
        setpoint.step(k * DT_NS, DT_S)
    assert CHAIN.forward(setpoint.q)[0, 3] < before - 1e-4


orders = st.one_of(
    st.tuples(st.just("twist"), st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6)),
    st.tuples(st.just("goal"), st.lists(st.floats(0.0, 1.0), min_size=6, max_size=6)),
    st.tuples(st.just("stop"), st.just([0.0] * 6)),
)


@given(st.lists(st.tuples(orders, st.integers(1, 80)), max_size=8))
@settings(max_examples=30)
def test_any_motion_stays_within_limits_and_comes_to_rest(script: list) -> None:  # type: ignore[type-arg]
    setpoint, k = standing(), 0

    def advance(steps: int) -> None:
        nonlocal k
        for _ in range(steps):
            before = setpoint.q
            q, dq = setpoint.step(k * DT_NS, DT_S)
            k += 1
            assert np.isfinite(q).all()
            assert (np.abs(dq) <= CHAIN.speed * 1.000001).all()
            assert (q >= CHAIN.lower - 1e-9).all()
            assert (q <= CHAIN.upper + 1e-9).all()
            speed = np.linalg.norm((CHAIN.forward(q) - CHAIN.forward(before))[:3, 3]) / DT_S
            assert speed <= LIMITS.speed_m_s * 1.05

    for (kind, values), steps in script:
        numbers = np.array(values)
        if kind == "twist":
            # As the gate would have limited it.
            linear, angular = np.linalg.norm(numbers[:3]), np.linalg.norm(numbers[3:])
            numbers[:3] *= min(1.0, LIMITS.speed_m_s / max(linear, 1e-9))
            numbers[3:] *= min(1.0, LIMITS.rot_speed_rad_s / max(angular, 1e-9))
            setpoint.follow(numbers, (k + 25) * DT_NS)
        elif kind == "goal":
            setpoint.go_to(CHAIN.lower + numbers * (CHAIN.upper - CHAIN.lower), 1.0)
        else:
            setpoint.stop()
        advance(steps)
    setpoint.stop()
    advance(120)
    assert not setpoint.moving
