"""Touching one edge of a side tells where its middle is."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.edge_search import EdgeSearch
from touchcell.control.push_model import Contact
from touchcell.control.push_steering import Pose

RADIUS_M, CLEAR_M = 0.02, 0.008


def touch(tip: Pose, direction_rad: float, middle: Pose, width_m: float) -> Contact | None:
    """Return where a round tip that moves on by twice the clearance touches a straight side; None where it does not."""
    x, y = middle.local((tip.x, tip.y))
    beyond_m = max(abs(y) - 0.5 * width_m, 0.0)
    # The tip is turned to the edge, and models read no contact that is more than 25 degrees beside its axis.
    if beyond_m >= RADIUS_M:
        return None
    angle = math.copysign(math.asin(beyond_m / RADIUS_M), -y)
    contact_x = -x - RADIUS_M * math.cos(angle)
    if contact_x > 2.0 * CLEAR_M or abs(math.remainder(middle.heading + angle - tip.heading, math.tau)) > 0.435:
        return None
    edge_y = math.copysign(min(abs(y), 0.5 * width_m), y)
    at = middle.ahead(edge_y, 0.5 * math.pi)
    return Contact(at.x, at.y, middle.heading + angle)


@given(st.floats(-0.02, 0.02), st.floats(-0.018, 0.018), st.floats(0.04, 0.12), st.floats(-0.02, 0.02))
def test_the_middle_is_found_from_20_mm_off_what_is_expected(
    off_m: float, expected_m: float, width_m: float, turned: float
) -> None:
    side = Contact(0.1, -0.05, 0.3)
    middle_m = expected_m + off_m
    middle = Pose(side.x_m, side.y_m, side.heading_rad).ahead(middle_m, 0.5 * math.pi)
    search = EdgeSearch(Contact(side.x_m, side.y_m, side.heading_rad + turned), expected_m, width_m, RADIUS_M)
    while search.middle is None and not search.failed:
        tip = search.tip(CLEAR_M)
        contact = touch(tip, search.direction_rad, middle, width_m)
        search.missed() if contact is None else search.touched(contact)
    assert search.middle is not None
    assert math.dist((search.middle.x_m, search.middle.y_m), (middle.x, middle.y)) < 1.5e-3


@given(st.sampled_from([-1.0, 1.0]), st.floats(0.1, 0.5), st.floats(0.04, 0.1), st.floats(-0.01, 0.01))
def test_a_first_contact_with_the_edge_itself_is_no_contact_with_the_side(
    left: float, turned: float, width_m: float, expected_m: float
) -> None:
    middle = Pose(0.2, 0.1, -0.2)
    edge = middle.ahead(left * 0.5 * width_m, 0.5 * math.pi)
    first = Contact(edge.x, edge.y, middle.heading - left * turned)
    search = EdgeSearch(first, expected_m - left * 0.02, width_m, RADIUS_M)
    side = Pose(first.x_m, first.y_m, middle.heading).ahead(-left * 0.6 * width_m, 0.5 * math.pi)
    search.touched(Contact(side.x, side.y, side.heading))
    assert search.middle is not None
    assert math.dist((search.middle.x_m, search.middle.y_m), (middle.x, middle.y)) < 1e-6
    assert search.middle.heading_rad == pytest.approx(middle.heading)


def test_a_side_that_never_ends_is_given_up() -> None:
    search = EdgeSearch(Contact(0.0, 0.0, 0.0), 0.0, 0.08, RADIUS_M)
    while not search.failed:
        at = search.tip(0.0)
        search.touched(Contact(0.0, at.y, 0.0))
    assert search.middle is None


@given(st.floats(-0.01, 0.01), st.floats(0.05, 0.12), st.floats(-0.002, 0.002))
def test_between_both_edges_normals_that_are_misread_and_a_wrong_width_cancel(
    middle_m: float, width_m: float, wider_m: float
) -> None:
    middle = Pose(0.1, 0.0, 0.2).ahead(middle_m, 0.5 * math.pi)
    first = EdgeSearch(Contact(0.1, 0.0, 0.2), 0.0, width_m + wider_m, RADIUS_M)
    other = None
    for search in (first, None):
        search = search or (other := first.opposite())
        while search.middle is None and not search.failed:
            tip = search.tip(CLEAR_M)
            contact = touch(tip, search.direction_rad, middle, width_m)
            if contact is None:
                search.missed()
                continue
            # A tilt that is read 8 % too small puts the edge too near to the tip.
            angle = contact.heading_rad - middle.heading
            inwards_m = RADIUS_M * (math.sin(abs(angle)) - math.sin(0.92 * abs(angle)))
            side = math.copysign(1.0, middle.local((contact.x_m, contact.y_m))[1])
            at = Pose(contact.x_m, contact.y_m, middle.heading).ahead(side * inwards_m, 0.5 * math.pi)
            search.touched(Contact(at.x, at.y, middle.heading + 0.92 * angle))
    assert other is not None
    found, _ = first.between(other)
    assert abs(middle.local((found.x_m, found.y_m))[1]) < 0.7e-3


def test_the_distance_between_two_edges_is_told_whatever_was_expected() -> None:
    first = EdgeSearch(Contact(0.0, 0.0, 0.0), 0.0, 0.08, RADIUS_M)
    first.touched(Contact(0.0, 0.04, -0.3))
    other = first.opposite()
    other.touched(Contact(0.0, -0.03, 0.3))
    found, width_m = first.between(other)
    assert found.y_m == pytest.approx(0.005)
    assert width_m == pytest.approx(0.07)


@given(st.sampled_from([-1.0, 1.0]), st.floats(-0.03, 0.03), st.floats(0.0, 1.5e-3))
def test_on_a_line_that_is_known_an_edge_is_where_its_distance_says_whatever_its_normal_is_read(
    left: float, misread: float, depth_m: float
) -> None:
    middle, width_m, turned = Pose(0.2, 0.1, -0.2), 0.06, 0.35
    search = EdgeSearch(Contact(middle.x, middle.y, middle.heading), 0.0, width_m, RADIUS_M, left=left)
    edge = middle.ahead(left * 0.5 * width_m, 0.5 * math.pi)
    tip = Pose(edge.x, edge.y, middle.heading - left * turned).ahead(depth_m - RADIUS_M)
    assert search.edge_on(middle) is None
    read = Pose(tip.x, tip.y, tip.heading + misread)
    felt = read.ahead(RADIUS_M - depth_m)
    search.touched(Contact(felt.x, felt.y, felt.heading, depth_m))
    assert search.edge_on(middle) == pytest.approx(left * 0.5 * width_m, abs=1e-9)


@given(st.sampled_from([-1.0, 1.0]), st.floats(0.08, 0.15), st.floats(0.06, 0.1))
def test_a_corner_that_was_touched_first_does_not_hide_how_the_side_lies(
    left: float, turned: float, width_m: float
) -> None:
    """The first contact and the edge that is found next are the same corner, so that only the other edge tells."""
    middle = Pose(0.2, 0.1, -0.2)
    corner = middle.ahead(left * 0.5 * width_m, 0.5 * math.pi)
    first = Contact(corner.x, corner.y, middle.heading - left * turned)
    search = EdgeSearch(first, 0.0, width_m, RADIUS_M, left=left)
    search.touched(Contact(corner.x, corner.y, first.heading_rad - left * 0.3))
    other = search.opposite()
    while other.middle is None and not other.failed:
        tip = other.tip(CLEAR_M)
        contact = touch(tip, other.direction_rad, middle, width_m)
        other.missed() if contact is None else other.touched(contact)
    found, felt_m = search.between(other)
    assert felt_m == pytest.approx(width_m, abs=1e-3)
    assert math.dist((found.x_m, found.y_m), (middle.x, middle.y)) < 1e-3


def test_two_contacts_6_mm_apart_do_not_tell_how_a_side_lies() -> None:
    """The first is 6 mm from the edge and 0.5 mm too near; a line through both is turned by 5 deg."""
    search = EdgeSearch(Contact(0.0, 0.0, 0.0), 0.0, 0.06, RADIUS_M, left=-1.0)
    search.touched(Contact(0.0005, -0.006, 0.16))
    assert search.middle is not None
    assert search.middle.heading_rad == 0.0
    assert search.left == -1.0
