"""The chains that ship against kinematics written down elsewhere: Universal Robots' and Franka's tables."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.drivers.core.chain_check import require_same_arm
from touchcell.drivers.core.errors import DeviceFault, FaultClass
from touchcell.drivers.franka.emulator import arm as franka_arm
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain, Tool
from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.geometry import se3

TOOL = Tool(origin_mm=(10, -5, 120), rotation_deg=(0, 15, 40))


def test_ur5e_pose_matches_its_table() -> None:
    chain = SerialChain(ChainDescription.shipped("ur5e"), TOOL)
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6)):
        T, J = ur_model.forward(q, TOOL.pose())
        np.testing.assert_allclose(chain.forward(q), T, atol=1e-12)
        np.testing.assert_allclose(chain.jacobian(q), J, atol=1e-12)


def test_fr3_pose_matches_its_table_and_stays_within_its_ranges() -> None:
    chain = SerialChain(ChainDescription.shipped("fr3"))
    for q in np.random.default_rng(0).uniform(franka_arm.JOINT_MIN_RAD, franka_arm.JOINT_MAX_RAD, (20, 7)):
        np.testing.assert_allclose(chain.forward(q), franka_arm.flange_pose(q)[0], atol=1e-12)
    assert (chain.lower >= franka_arm.JOINT_MIN_RAD).all()
    assert (chain.upper <= franka_arm.JOINT_MAX_RAD).all()


# Stretched along -x: a2 + a3, and d4 + d6 to the side, of the table.
@pytest.mark.parametrize(
    ("name", "reach_mm", "side_mm"),
    [("ur3e", 456.75, 223.15), ("ur5e", 817.2, 232.9), ("ur10e", 1184.25, 290.7), ("ur16e", 838.4, 290.7)],
)
def test_the_reach_of_urs_matches_their_tables(name: str, reach_mm: float, side_mm: float) -> None:
    T = SerialChain(ChainDescription.shipped(name)).forward(np.zeros(6))
    np.testing.assert_allclose(1e3 * T[:2, 3], [-reach_mm, -side_mm], atol=1e-9)


def test_a_range_is_narrowed_and_never_widened() -> None:
    chain = ChainDescription.shipped("fr3")
    wide = np.array([[-400.0, 400.0]] * 7)
    assert chain.narrowed(wide) == chain
    narrow = wide.copy()
    narrow[2] = [-10.0, 20.0]
    joint = chain.narrowed(narrow).joints[2]
    assert (joint.lower_deg, joint.upper_deg) == (-10.0, 20.0)


@pytest.mark.parametrize("off_mm_deg", [(0, 0, 25, 0, 0, 0), (0, 0, 0, 0, 2.5, 0)])
def test_a_different_arm_model_is_refused_and_a_calibrated_one_is_not(off_mm_deg: tuple[float, ...]) -> None:
    chain = SerialChain(ChainDescription.shipped("ur5e"))
    q = np.array([0.1, -1.2, 1.4, -1.0, -1.5, 0.3])
    require_same_arm("arm", chain, q, chain.forward(q) @ se3.from_euler_mm_deg(0.4 * np.array(off_mm_deg)))
    with pytest.raises(DeviceFault) as caught:
        require_same_arm("arm", chain, q, chain.forward(q) @ se3.from_euler_mm_deg(np.array(off_mm_deg)))
    assert caught.value.fault_class is FaultClass.CONFIGURATION
