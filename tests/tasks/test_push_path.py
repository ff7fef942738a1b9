"""Planned paths: as short as Dubins paths, of the given turning radius, clear of obstacles, and ending at the goal."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.simulation.shapes import Prism
from touchcell.simulation.solids import friction_radius_m
from touchcell.tasks.push_path import STEP_M, NoPathFound, Obstacle, length_m, min_turning_radius_m, plan

START = (0.0, 0.0, 0.0)
TURN_M = 0.08


def headings(points):
    return [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]


def turned(a, b):
    return abs(math.remainder(b - a, 2.0 * math.pi))


def test_straight_ahead_is_a_straight_line():
    way = plan(START, (0.3, 0.0, 0.0), TURN_M)
    assert length_m([START[:2], *way]) == pytest.approx(0.3)
    assert np.abs(np.array(way)[:, 1]).max() < 1e-9


def test_a_quarter_turn_is_one_arc():
    way = plan(START, (TURN_M, TURN_M, math.pi / 2), TURN_M)
    assert length_m([START[:2], *way]) == pytest.approx(0.5 * math.pi * TURN_M, rel=1e-3)


def test_turning_round_on_the_spot_takes_three_arcs():
    """The known length of the path back to the start with opposite heading: 7 pi / 3 radii."""
    way = plan(START, (0.0, 0.0, math.pi), TURN_M)
    assert length_m([START[:2], *way]) == pytest.approx(7.0 * math.pi / 3.0 * TURN_M, rel=2e-3)


POSES = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-math.pi, math.pi))


@settings(max_examples=60)
@given(goal=POSES)
def test_paths_are_smooth_and_end_at_the_goal(goal):
    if math.hypot(goal[0], goal[1]) < 0.02:
        return
    way = [START[:2], *plan(START, goal, TURN_M)]
    assert way[-1] == goal[:2]
    assert length_m(way) >= math.hypot(goal[0], goal[1]) - 1e-9
    steps = [math.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(way)]
    assert max(steps) <= STEP_M + 1e-9
    # A chord is turned by half of its arc's angle.
    for (before, after), (a, b) in zip(pairwise(headings(way)), pairwise(steps), strict=True):
        assert turned(before, after) <= 0.5 * (a + b) / TURN_M * 1.01 + 1e-6
    assert turned(headings(way)[0], 0.0) <= steps[0] / TURN_M
    assert turned(headings(way)[-1], goal[2]) <= steps[-1] / TURN_M


@pytest.mark.parametrize("beside_m", [0.0, 0.02, -0.03])
def test_an_obstacle_is_passed_on_the_nearer_side(beside_m):
    obstacle = Obstacle(0.2, beside_m, 0.07)
    way = plan(START, (0.4, 0.0, 0.0), TURN_M, [obstacle])
    near = min(math.hypot(x - obstacle.x_m, y - obstacle.y_m) for x, y in way)
    assert near >= obstacle.radius_m - 1e-5
    assert 0.4 < length_m([START[:2], *way]) < 0.47
    if beside_m:
        middle = min(way, key=lambda p: abs(p[0] - 0.2))
        assert math.copysign(1.0, middle[1]) == -math.copysign(1.0, beside_m)


def test_without_a_clear_path_it_raises():
    with pytest.raises(NoPathFound, match="400"):
        plan(START, (0.4, 0.0, 0.0), TURN_M, [Obstacle(0.4, 0.0, 0.05)])


def test_the_smallest_turning_radius_puts_the_force_on_the_friction_cone():
    square = Prism(0.04 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]), 0.06)
    c = friction_radius_m(square)
    turn_m = min_turning_radius_m(0.04, c, 0.9)
    # A force on the edge of the friction cone, and its motion by the limit surface.
    fx, fy = math.cos(math.atan(0.9)), math.sin(math.atan(0.9))
    assert turn_m == pytest.approx(abs(fx / (-0.04 * fy / c**2)))
    assert 1e3 * turn_m == pytest.approx(26.0, abs=0.1)
