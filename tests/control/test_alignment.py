"""Paths, and steering a pushed object along them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.alignment import AlignmentGains, TargetAlignment
from touchcell.control.errors import ControlError
from touchcell.control.path import Path
from touchcell.geometry import se3

CORNER = Path([(0.0, 0.0), (0.3, 0.0), (0.3, 0.2)])
GAINS = AlignmentGains(kp=0.17, ki=3.5, kd=0.0, limit_m_s=0.01, look_ahead_m=0.04, lead_m=0.06)
FORWARD = se3.from_euler_mm_deg(np.array([-60.0, 0.0, 30.0, 0.0, 90.0, 0.0]))
"""T_base_sensor: z along x of the base, x down, y along y."""


def test_points_and_directions_of_a_path_by_arc_length():
    assert CORNER.length_m == pytest.approx(0.5)
    assert CORNER.point(0.1) == pytest.approx((0.1, 0.0))
    assert CORNER.point(0.4) == pytest.approx((0.3, 0.1))
    assert CORNER.point(0.6) == pytest.approx((0.3, 0.3))
    assert CORNER.direction(0.6) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("p", "along", "aside"),
    [
        ((0.1, 0.02), 0.1, 0.02),
        ((0.1, -0.02), 0.1, -0.02),
        ((0.32, 0.1), 0.4, -0.02),
        ((0.28, 0.3), 0.6, 0.02),
        ((-0.05, 0.01), -0.05, 0.01),
        ((0.33, -0.04), 0.3, -0.05),
    ],
)
def test_a_place_has_arc_length_and_cross_track_error(p, along, aside):
    place = CORNER.place(p, 0.0, 1.0)
    assert (place.along_m, place.cross_track_error_m) == pytest.approx((along, aside))


def test_a_place_is_searched_near_the_previous_one():
    there_and_back = Path([(0.0, 0.0), (0.3, 0.0), (0.3, 0.01), (0.0, 0.01)])
    assert there_and_back.place((0.1, 0.009), 0.08, 0.05).along_m == pytest.approx(0.1)
    assert there_and_back.place((0.1, 0.001), 0.45, 0.1).along_m == pytest.approx(0.51)


@given(s=st.floats(0.0, 0.5), off=st.floats(-0.01, 0.01))
def test_points_beside_a_path_are_found_again(s, off):
    x, y = CORNER.point(s)
    dx, dy = CORNER.direction(s)
    place = CORNER.place((x - off * dy, y + off * dx), 0.0, 1.0)
    assert abs(place.cross_track_error_m) <= abs(off) + 1e-12
    assert place.along_m == pytest.approx(s, abs=0.015)


@pytest.mark.parametrize("points", [[(0.0, 0.0)], [(0.0, 0.0), (0.0, 0.0)]])
def test_invalid_paths_are_refused(points):
    with pytest.raises(ControlError):
        Path(points)


def test_the_contact_goes_to_the_other_side_of_the_target():
    for target_y, sign in ((0.1, -1.0), (-0.1, 1.0)):
        alignment = TargetAlignment(lambda middle, heading, y=target_y: [(0.3, y)], GAINS)
        aim = alignment.aim(FORWARD, np.eye(4))
        assert math.copysign(1.0, aim.theta_rad) == -sign
        assert aim.target_lateral_error_m == pytest.approx(target_y)
        assert aim.remaining_m == pytest.approx(math.hypot(0.3, 0.1))
        assert alignment.step(aim, 0.01) == pytest.approx(sign * GAINS.limit_m_s)


def test_straight_ahead_nothing_moves_sideways():
    alignment = TargetAlignment(lambda middle, heading: [(0.3, 0.0)], GAINS)
    assert alignment.step(alignment.aim(FORWARD, np.eye(4)), 0.01) == pytest.approx(0.0, abs=1e-12)


def test_the_object_is_nearer_to_the_tip_by_the_depth_of_the_contact():
    touching = TargetAlignment(lambda middle, heading: [(0.3, 0.0)], GAINS).aim(FORWARD, np.eye(4))
    T_f_s = se3.from_euler_mm_deg(np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0]))
    pressed = TargetAlignment(lambda middle, heading: [(0.3, 0.0)], GAINS).aim(FORWARD, se3.inverse(T_f_s))
    assert pressed.target_distance_m - touching.target_distance_m == pytest.approx(0.004)
    assert pressed.remaining_m - touching.remaining_m == pytest.approx(0.004)


def test_heading_is_that_of_the_contact_normal_not_of_the_sensor():
    alignment = TargetAlignment(lambda middle, heading: [(0.3, 0.0)], GAINS)
    # About the sensor's x axis, which points down: to the right as seen from above.
    T_s_f = se3.from_euler_mm_deg(np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0]))
    assert math.degrees(alignment.aim(FORWARD, T_s_f).heading_rad) == pytest.approx(-10.0)
    upside_down = FORWARD @ se3.from_euler_mm_deg(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 180.0]))
    assert math.degrees(alignment.aim(upside_down, T_s_f).heading_rad) == pytest.approx(10.0)


def steered(gains: AlignmentGains, points: list[tuple[float, float]], crab_rad: float, length_m: float) -> list[float]:
    """Return the distance from the path at every mm of a push of an object with known closed-form motion.

    Its centre moves along its heading, rotated by ``crab_rad`` since it is not pushed through its centre, and it turns
    by 15.8 rad per m of the contact's lateral motion (an 80 mm square).
    """
    alignment = TargetAlignment(lambda middle, heading: points, gains)
    x, y, heading, asides = 0.0, 0.0, 0.0, []
    for _ in range(round(length_m / 0.0002)):
        c, s = math.cos(heading), math.sin(heading)
        T = np.array([[0.0, -s, c, x - 0.06 * c], [0.0, c, s, y - 0.06 * s], [-1.0, 0.0, 0.0, 0.0], [0, 0, 0, 1.0]])
        aim = alignment.aim(T, np.eye(4))
        asides.append(aim.cross_track_error_m)
        if aim.remaining_m <= 0.0:
            break
        heading -= 15.8 * alignment.step(aim, 0.01) * 0.01
        x, y = x + 0.0002 * math.cos(heading + crab_rad), y + 0.0002 * math.sin(heading + crab_rad)
    return asides


@pytest.mark.parametrize("crab_deg", [0.0, 4.0, -8.0])
def test_an_object_that_drifts_sideways_still_reaches_the_target(crab_deg):
    asides = steered(GAINS, [(0.3, 0.06)], math.radians(crab_deg), 1.0)
    assert abs(asides[-1]) < 0.001
    assert 1400 < len(asides) < 1700


def test_a_curved_path_is_followed():
    asides = steered(GAINS, [(0.15, 0.0), (0.3, 0.06), (0.45, 0.06)], 0.0, 1.0)
    assert max(map(abs, asides)) < 0.008
    assert abs(asides[-1]) < 0.001


def test_without_integral_action_the_object_arrives_beside_the_target():
    asides = steered(AlignmentGains(0.17, 0.0, 0.0, 0.01, 0.04, 0.06), [(0.3, 0.0)], math.radians(4.0), 1.0)
    assert abs(asides[-1]) == pytest.approx(0.04 * math.tan(math.radians(4.0)), rel=0.1)
