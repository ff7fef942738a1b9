import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.errors import ConfigError
from touchcell.simulation.motions import Glide, Motion, Periodic, Still
from touchcell.simulation.surfaces import Dome, Plane, Ramp, Shape, Sphere, Surface

coordinate = st.floats(-0.08, 0.08)
SHAPES: list[Shape] = [Plane(), Sphere(0.05), Dome(0.05), Ramp(0.06, 0.5), Ramp(0.06, -0.5)]


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@given(x=coordinate, y=coordinate, lift=st.floats(0.001, 0.03))
def test_nearest_point_is_on_the_surface_and_along_the_normal(shape: Shape, x: float, y: float, lift: float) -> None:
    on_surface = shape.nearest(np.array([x, y, 0.08])).point
    normal = shape.nearest(on_surface + 1e-9 * np.array([0, 0, 1.0])).normal
    found = shape.nearest(on_surface + lift * normal)
    assert np.linalg.norm(found.normal) == pytest.approx(1.0)
    np.testing.assert_allclose(found.point + found.distance_m * found.normal, on_surface + lift * normal, atol=1e-12)
    assert shape.nearest(found.point).distance_m == pytest.approx(0.0, abs=1e-12)
    # Another surface point may be nearer near a hollow edge, never farther.
    assert found.distance_m <= lift + 1e-12


@pytest.mark.parametrize("shape", [Ramp(0.06, 0.5), Ramp(0.06, -0.5), Dome(0.05)], ids=str)
@given(x=coordinate, lift=st.floats(0.002, 0.03))
def test_nearest_point_beats_a_dense_search(shape: Shape, x: float, lift: float) -> None:
    p = shape.nearest(np.array([x, 0.0, 0.08])).point + np.array([0.0, 0.0, lift])
    sampled = [shape.nearest(np.array([s, 0.0, 0.02])).point for s in np.linspace(-0.12, 0.12, 400)]
    dense = min(float(np.linalg.norm(p - q)) for q in sampled)
    found = shape.nearest(p)
    assert found.distance_m <= dense + 1e-9
    assert found.distance_m >= dense - 1e-3


@pytest.mark.parametrize("incline_rad", [0.5, -0.5])
def test_ramp_profile_is_continuous_in_height_and_slope(incline_rad: float) -> None:
    ramp = Ramp(0.06, incline_rad)
    end = 0.06 * math.sin(abs(incline_rad))
    for junction in (0.0, end):
        z = 0.0 if junction == 0.0 else math.copysign(0.06 * (1 - math.cos(incline_rad)), incline_rad)
        before, after = (ramp.nearest(np.array([junction + side, 0.0, z])) for side in (-1e-7, 1e-7))
        assert np.linalg.norm(before.normal - after.normal) < 1e-5
        assert abs(before.distance_m) < 1e-7
        assert abs(after.distance_m) < 1e-7
    far = ramp.nearest(np.array([0.2, 0.0, 0.2]))
    assert math.atan2(-far.normal[0], far.normal[2]) == pytest.approx(incline_rad)


@pytest.mark.parametrize("incline_rad", [0.0, 1.6, -1.6])
def test_ramp_refuses_inclines_that_are_none(incline_rad: float) -> None:
    with pytest.raises(ConfigError) as caught:
        Ramp(0.06, incline_rad)
    assert caught.value.key == "incline_rad"


MOTIONS: list[Motion] = [
    Still(pose(0.1, yaw=0.3)),
    Glide(pose(0.1, yaw=0.3), np.array([0, 0.2, 0, 0, 0, 0.0]), start_s=0.5, duration_s=2.0),
    Glide(pose(0.1, yaw=0.3), np.array([0, 0, 0, 0, 0.6, 0.0]), start_s=0.5, duration_s=2.0),
    Periodic(
        pose(0.1, yaw=0.3),
        np.array([0.075, 0.075, 0.02, 0.2, 0.3, 0.4]),
        np.array([0.0, 1.57, 0.3, 1.0, 2.0, 0.5]),
        period_s=8.0,
        ramp_s=1.0,
    ),
]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
@pytest.mark.parametrize("t_s", [0.3, 0.8, 1.4, 2.2, 5.0])
def test_twist_is_the_derivative_of_the_pose(motion: Motion, t_s: float) -> None:
    h = 1e-5
    before, after = motion.pose(t_s - h), motion.pose(t_s + h)
    spin = (after[:3, :3] - before[:3, :3]) / (2 * h) @ motion.pose(t_s)[:3, :3].T
    twist = motion.twist(t_s)
    np.testing.assert_allclose(twist[:3], (after[:3, 3] - before[:3, 3]) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(twist[3:], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8)


def test_glide_covers_its_displacement_and_rests_at_both_ends() -> None:
    glide = Glide(pose(), np.array([0.2, 0, 0, 0, 0, 0.0]), start_s=1.0, duration_s=4.0)
    assert glide.pose(0.0)[0, 3] == 0.0
    assert glide.pose(3.0)[0, 3] == pytest.approx(0.1)
    assert glide.pose(9.0)[0, 3] == pytest.approx(0.2)
    for t_s in (0.0, 1.0, 5.0, 9.0):
        np.testing.assert_array_equal(glide.twist(t_s), np.zeros(6))


def test_periodic_starts_from_rest_and_draws_the_circle() -> None:
    motion = Periodic(
        pose(), np.array([0.075, 0.075, 0, 0, 0, 0]), np.array([0, math.pi / 2, 0, 0, 0, 0]), period_s=6.0, ramp_s=1.0
    )
    np.testing.assert_array_equal(motion.pose(0.0), np.eye(4))
    np.testing.assert_array_equal(motion.twist(0.0), np.zeros(6))
    centre = np.array([0.0, -0.075, 0.0])
    for t_s in np.linspace(0.0, 7.0, 20):
        assert np.linalg.norm(motion.pose(t_s)[:3, 3] - centre) == pytest.approx(0.075)


def test_periodic_stands_until_its_start_and_then_moves_as_from_time_zero() -> None:
    amplitude = np.array([0.075, 0.02, 0.01, 0.1, 0.2, 0.3])
    at_once, later = (Periodic(pose(), amplitude, np.zeros(6), 6.0, 1.0, start_s=start_s) for start_s in (0.0, 2.5))
    np.testing.assert_array_equal(later.pose(2.5), np.eye(4))
    np.testing.assert_array_equal(later.twist(2.5), np.zeros(6))
    for t_s in (0.3, 1.0, 4.0):
        np.testing.assert_allclose(later.pose(2.5 + t_s), at_once.pose(t_s), atol=1e-15)
        np.testing.assert_allclose(later.twist(2.5 + t_s), at_once.twist(t_s), atol=1e-15)


def test_a_surface_moves_with_its_motion() -> None:
    plate = Surface(Plane(), Glide(pose(z=0.1), np.array([0, 0, 0.2, 0, 0, 0.0]), start_s=0.0, duration_s=1.0))
    assert plate.nearest(np.array([0.0, 0.0, 0.15]), 0.0).distance_m == pytest.approx(0.05)
    assert plate.nearest(np.array([0.0, 0.0, 0.15]), 1.0).distance_m == pytest.approx(-0.15)
