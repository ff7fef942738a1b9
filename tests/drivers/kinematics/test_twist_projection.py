from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain, Tool
from touchcell.drivers.kinematics.twist_projection import project_to_feasible

CHAIN = SerialChain(ChainDescription.shipped("so101_5r"), Tool(origin_mm=(0.0, 0.0, 40.0)))
DOWN = np.deg2rad([0.0, 10.0, 90.0, 80.0, 0.0])
FORWARD = np.deg2rad([0.0, -30.0, 110.0, 10.0, 0.0])

twists = st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6).map(np.array)
poses = st.tuples(
    st.floats(-100, 100), st.floats(-40, 40), st.floats(60, 120), st.floats(-60, 80), st.floats(-150, 150)
).map(lambda q: np.deg2rad(q))


@pytest.mark.parametrize("axis", [0, 1, 2, 4, 5])
def test_with_the_tool_down_all_but_the_sideways_tilt_is_followed(axis: int) -> None:
    twist = np.eye(6)[axis] * 0.1
    followed, adjustments = project_to_feasible(CHAIN.jacobian(DOWN), twist)
    np.testing.assert_allclose(followed, twist, atol=1e-12)
    assert adjustments == ()


def test_the_sideways_tilt_is_lost_and_reported() -> None:
    twist = np.array([0.03, 0.0, 0.0, 0.1, 0.2, 0.0])
    followed, adjustments = project_to_feasible(CHAIN.jacobian(DOWN), twist)
    np.testing.assert_allclose(followed, [0.03, 0.0, 0.0, 0.0, 0.2, 0.0], atol=1e-12)
    (lost,) = adjustments
    assert lost.limit == "joints: angular"
    assert (lost.requested, lost.allowed) == (pytest.approx(np.hypot(0.1, 0.2)), pytest.approx(0.2))


def test_rotation_is_reported_where_the_tip_cannot_move_without_it() -> None:
    # Tool forward: only the pan joint moves it sideways, and the roll joint cannot turn it back.
    followed, adjustments = project_to_feasible(CHAIN.jacobian(FORWARD), np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
    reach_m = CHAIN.forward(FORWARD)[0, 3]
    np.testing.assert_allclose(followed, [0.0, 0.1, 0.0, 0.0, 0.0, 0.1 / reach_m], atol=1e-9)
    assert [a.limit for a in adjustments] == ["joints: angular"]
    assert adjustments[0].requested == 0.0


@given(poses, twists)
def test_the_tip_keeps_its_velocity_and_projecting_twice_changes_nothing(q: np.ndarray, twist: np.ndarray) -> None:
    J = CHAIN.jacobian(q)
    # Close to where the arm is stretched or above its base, linear velocity is lost too.
    if np.linalg.svd(J[:3], compute_uv=False)[-1] < 0.02:
        return
    followed, adjustments = project_to_feasible(J, twist)
    np.testing.assert_allclose(followed[:3], twist[:3], atol=1e-9)
    again, _ = project_to_feasible(J, followed)
    np.testing.assert_allclose(again, followed, atol=1e-6)
    changed = bool(np.linalg.norm(followed[3:] - twist[3:]) > 1e-4)
    assert [a.limit for a in adjustments] == (["joints: angular"] if changed else [])


def test_six_joints_follow_everything() -> None:
    chain = SerialChain(ChainDescription.shipped("generic_6r"))
    J = chain.jacobian(np.deg2rad([10.0, 40.0, 90.0, 20.0, 50.0, 0.0]))
    twist = np.array([0.05, -0.02, 0.03, 0.1, -0.2, 0.3])
    followed, adjustments = project_to_feasible(J, twist)
    np.testing.assert_allclose(followed, twist, atol=1e-12)
    assert adjustments == ()
