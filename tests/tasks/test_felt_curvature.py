"""The curvature that a moving tip has felt, and the turn and the speed that follow from it."""

import math

import numpy as np
import pytest

from touchcell.geometry.types import Array
from touchcell.tasks.felt_curvature import CurvedWay, FeltCurvature

UP = np.array([0.0, 0.0, 1.0])


def down_a_ball(radius_m: float, angle_rad: float, around_rad: float = 0.0) -> tuple[Array, Array]:
    """Return a point of a ball and its inward normal, an angle away from its top."""
    across = np.array([math.cos(around_rad), math.sin(around_rad), 0.0])
    outward = math.sin(angle_rad) * across + math.cos(angle_rad) * UP
    return radius_m * outward, -outward


def test_on_a_ball_the_normal_turns_with_the_radius_in_every_direction() -> None:
    felt = FeltCurvature(8e-3)
    for way in np.arange(0.0, 20e-3, 0.3e-3):
        felt.update(*down_a_ball(0.07, way / 0.07))
    for way in np.arange(0.0, 20e-3, 0.3e-3):
        at, normal = down_a_ball(0.07, 20e-3 / 0.07, way / 0.03)
        felt.update(at, normal)
    for direction in (np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, 0.0])):
        along = direction - float(direction @ normal) * normal
        along /= np.linalg.norm(along)
        assert np.linalg.norm(felt.turn_rad_per_m(along, normal)) == pytest.approx(1.0 / 0.07, rel=0.15)


def test_the_turn_changes_sign_with_the_direction() -> None:
    felt = FeltCurvature(8e-3)
    for way in np.arange(0.0, 20e-3, 0.3e-3):
        at, normal = down_a_ball(0.05, way / 0.05)
        felt.update(at, normal)
    along = np.cross([0.0, 1.0, 0.0], -normal)
    forth, back = felt.turn_rad_per_m(along, normal), felt.turn_rad_per_m(-along, normal)
    assert forth == pytest.approx(-back)
    # Carried on, the turn takes the normal to where it will be.
    ahead = normal + 1e-3 * np.cross(forth, normal)
    assert ahead == pytest.approx(down_a_ball(0.05, (19.8e-3 + 1e-3) / 0.05)[1], abs=3e-3)


def test_nothing_is_known_before_the_tip_has_moved() -> None:
    felt = FeltCurvature(8e-3)
    for _ in range(20):
        felt.update(np.zeros(3), -UP)
    assert not felt.turn_rad_per_m(np.array([1.0, 0.0, 0.0]), -UP).any()


def test_behind_a_crease_the_bend_before_it_is_forgotten() -> None:
    felt, fresh = FeltCurvature(8e-3), FeltCurvature(8e-3)
    x = np.array([1.0, 0.0, 0.0])
    for way in np.arange(0.0, 10e-3, 0.3e-3):
        felt.update(*down_a_ball(0.03, way / 0.03))
    for way in np.arange(0.0, 4e-3, 0.3e-3):
        for each in (felt, fresh):
            each.update(np.array([10e-3 + way, 0.0, 0.0]), -UP)
    assert np.linalg.norm(felt.turn_rad_per_m(x, -UP)) < 0.2 / 0.03
    assert np.linalg.norm(fresh.turn_rad_per_m(x, -UP)) < 1e-6


def test_speed_falls_where_the_surface_turns_faster_than_the_sensor_may_and_with_a_tilt() -> None:
    way = CurvedWay(30e-3, math.radians(60.0), 8e-3)
    ahead, T_s_f = np.array([1.0, 0.0, 0.0]), np.eye(4)
    flat = np.eye(4)
    assert np.linalg.norm(way.update(ahead, flat, T_s_f)[:3]) == pytest.approx(30e-3)
    for angle in np.arange(0.0, 1.0, 0.02):
        at, inward = down_a_ball(0.02, angle)
        T = np.eye(4)
        T[:3, 0], T[:3, 2], T[:3, 3] = np.cross([0.0, 1.0, 0.0], inward), inward, at
        T[:3, 1] = [0.0, 1.0, 0.0]
        twist = way.update(np.array([-1.0, 0.0, 0.0]), T, T_s_f)
    assert np.linalg.norm(twist[3:]) == pytest.approx(math.radians(24.0), rel=0.05)
    assert np.linalg.norm(twist[:3]) == pytest.approx(0.02 * math.radians(24.0), rel=0.2)

    tilted = np.eye(4)
    tilted[1:3, 1:3] = [[math.cos(0.14), -math.sin(0.14)], [math.sin(0.14), math.cos(0.14)]]
    assert np.linalg.norm(CurvedWay(30e-3, 1.0, 8e-3).update(ahead, flat, tilted)[:3]) < 15e-3
