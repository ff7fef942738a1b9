import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.mount import MountModel


def contact(*pose_mm_deg: float) -> np.ndarray:
    return se3.from_euler_mm_deg(pose_mm_deg)


def left(rig: MountModel, *pose_mm_deg: float) -> np.ndarray:
    return se3.to_euler_mm_deg(rig.contact(contact(*pose_mm_deg)))


def test_a_perfect_mount_leaves_a_command_that_sticks() -> None:
    np.testing.assert_allclose(
        left(MountModel(), 0.5, -0.3, 5.0, 8.0, -6.0, 0.0), [0.5, -0.3, 5.0, 8.0, -6.0, 0.0], atol=1e-6
    )


def test_shear_saturates_at_the_limit_of_its_depth() -> None:
    rig = MountModel()
    for depth in (1.0, 2.0, 3.0):
        longest = 0.34 * depth**1.83
        assert np.hypot(*left(rig, 4.0, -3.0, depth, 0, 0, 0)[:2]) == pytest.approx(longest, rel=1e-3)
        # The direction stays.
        np.testing.assert_allclose(np.divide(*left(rig, 4.0, -3.0, depth, 0, 0, 0)[:2]), -4 / 3)


def test_a_tool_point_beside_the_axis_makes_depth_change_with_tilt() -> None:
    rig = MountModel(offset_m=(0.0, 2.5e-3))
    depths = [left(rig, 0, 0, 3.0, alpha, 0, 0)[2] for alpha in (-20.0, 0.0, 20.0)]
    np.testing.assert_allclose(depths, 3.0 + 2.5 * np.sin(np.radians([-20.0, 0.0, 20.0])), atol=1e-9)


def test_a_surface_that_is_not_level_tilts_straight_contacts() -> None:
    assert left(MountModel(level_rad=(0.02, 0.0)), 0, 0, 3.0, 0, 0, 0)[3] == pytest.approx(np.degrees(0.02))
    assert left(MountModel(press_slant=(0.05, 0.0)), 0, 0, 3.0, 0, 0, 0)[0] == pytest.approx(0.15, rel=1e-3)


def test_shear_along_the_slope_sticks_better_one_way_than_the_other() -> None:
    rig = MountModel(uphill=0.4)
    one, other = (np.hypot(*left(rig, 0.0, y, 3.0, 20.0, 0, 0)[:2]) for y in (5.0, -5.0))
    straight = np.hypot(*left(rig, 0.0, 5.0, 3.0, 0, 0, 0)[:2])
    assert min(one, other) < 0.9 * straight
    assert max(one, other) > 1.1 * straight


def test_torsion_is_lost_where_shear_slips_and_rotates_the_shear() -> None:
    rig = MountModel()
    held, slipping = left(rig, 0.1, 0, 3.0, 0, 0, 5.0), left(rig, 5.0, 0, 3.0, 0, 0, 5.0)
    assert held[5] == pytest.approx(5.0, rel=0.01)
    assert slipping[5] < 2.0
    command, T = contact(5.0, 0, 3.0, 10.0, -5.0, 5.0), rig.contact(contact(5.0, 0, 3.0, 10.0, -5.0, 5.0))
    asked, found = (each[:3, :3].T @ np.array([each[0, 3], each[1, 3], 0.0]) for each in (command, T))
    np.testing.assert_allclose(np.cross(asked, found), 0.0, atol=1e-12)


def test_out_of_contact_there_is_no_shear() -> None:
    T = left(MountModel(), 2.0, 1.0, -1.0, 5.0, 0, 3.0)
    np.testing.assert_allclose(T[:2], 0.0, atol=1e-12)
    assert T[2] == pytest.approx(-1.0)


def test_a_batch_is_its_members() -> None:
    rig = MountModel(
        offset_m=(1e-3, 2e-3), give=(0.04, 0.03), uphill=0.3, level_rad=(0.01, -0.01), press_slant=(0.02, 0)
    )
    batch = np.stack([contact(1, 2, 4, 5, 6, 3), contact(0, 0, -1, 0, 0, 0), contact(-4, 1, 2.5, -20, 3, -4)])
    for T, found in zip(batch, rig.contact(batch), strict=True):
        np.testing.assert_allclose(rig.contact(T), found, atol=1e-12)
        assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)
