"""An arm that a keeper lowers goes down slowly, never up, and comes to an end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.damiao.descent import Descent
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain, Tool

CHAIN = SerialChain(
    ChainDescription.shipped("generic_6r"), Tool(origin_mm=(0.0, 0.0, 80.0), mass_kg=0.15, com_mm=(0.0, 0.0, 40.0))
)
DT_S = 0.004
SPEED_M_S = 0.04


def work_m(q_before: np.ndarray, q_after: np.ndarray) -> float:
    """Return the work against gravity, J, of a small step."""
    return float(CHAIN.gravity_torques(0.5 * (q_before + q_after)) @ (q_after - q_before))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(0.05, 0.95), min_size=6, max_size=6))
def test_every_step_goes_down_and_none_is_faster_than_the_limit(shares: list[float]) -> None:
    q = CHAIN.lower + np.array(shares) * (CHAIN.upper - CHAIN.lower)
    descent = Descent(CHAIN, q, SPEED_M_S)
    for _ in range(300):
        before = descent.q
        after = descent.step(before, DT_S)
        assert work_m(before, after) <= 1e-9
        moved_m = np.linalg.norm(CHAIN.forward(after)[:3, 3] - CHAIN.forward(before)[:3, 3])
        assert moved_m <= 1.01 * SPEED_M_S * DT_S
        assert (after >= CHAIN.lower).all()
        assert (after <= CHAIN.upper).all()


def test_it_ends_where_nothing_can_go_down_any_more() -> None:
    descent = Descent(CHAIN, np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0]), SPEED_M_S)
    for _ in range(20_000):
        descent.step(descent.q, DT_S)
        if descent.rests:
            break
    assert descent.rests
    rest = descent.q.copy()
    assert np.array_equal(descent.step(rest, DT_S), rest)


@pytest.mark.parametrize("joint", [1, 2])
def test_a_joint_that_something_supports_stays_where_it_is(joint: int) -> None:
    start = np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0])
    descent = Descent(CHAIN, start, SPEED_M_S)
    supported = start.copy()
    for _ in range(3000):
        measured = descent.q.copy()
        measured[joint] = supported[joint]
        descent.step(measured, DT_S)
    assert abs(descent.q[joint] - start[joint]) <= np.deg2rad(3.1)


def test_an_arm_that_was_only_late_goes_on() -> None:
    start = np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0])
    descent = Descent(CHAIN, start, SPEED_M_S)
    for _ in range(3000):
        descent.step(start, DT_S)
    held = descent.q.copy()
    assert descent.rests
    for _ in range(500):
        descent.step(descent.q, DT_S)
    assert not np.allclose(descent.q, held, atol=np.deg2rad(2.0))
