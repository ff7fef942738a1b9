"""What a predictive push knows of the heading of the side that it pushes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from touchcell.geometry.types import Array
from touchcell.tasks.predictive_push import PredictivePush, PredictivePushSettings

TIP_M, DEPTH_M, REACH_M = 0.020, 0.0005, 0.030


def push_of(width_m: float) -> PredictivePush:
    settings = PredictivePushSettings(
        lead_m=REACH_M + TIP_M,
        tip_radius_m=TIP_M,
        lever_m2=0.024**2,
        flat=True,
        speed_m_s=0.1,
        max_tip_m_s=0.14,
        max_turn_rad_s=0.4,
        slowest_m_s=0.005,
        accel_m_s2=0.2,
        friction=0.8,
        look_ahead_m=0.06,
        goal_heading_rad=None,
        recontact_m=0.006,
        side_width_m=width_m,
    )
    return PredictivePush(settings, lambda center, heading: [(0.3, 0.0)], has_waypoints=False)


def sensor_at(x_m: float, y_m: float, heading_rad: float = 0.0) -> Array:
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[0.0, -sin, cos, x_m], [0.0, cos, sin, y_m], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def contact(T_base_sensor: Array, normal_rad: float, depth_m: float) -> Array:
    """Return T_s_f (4, 4) of a contact whose inward normal has a heading in the base's frame."""
    normal = np.array([math.cos(normal_rad), math.sin(normal_rad), 0.0])
    T = np.eye(4)
    T[:3, 2] = T_base_sensor[:3, :3].T @ normal
    T[:3, 0] = [1.0, 0.0, 0.0]
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    T[:3, 3] = -depth_m * T[:3, 2]
    return T


def felt(start: Array, goal: Array, half_m: float, misread_m: float = 0.0) -> tuple[Array, Array | None]:
    """Return where a way ends that feels for a side along y, and its contact there."""
    for share in np.linspace(0.0, 1.0, 1601):
        T = goal.copy()
        T[:3, 3] = start[:3, 3] + share * (goal[:3, 3] - start[:3, 3])
        beyond = float(T[1, 3] - np.clip(T[1, 3], -half_m, half_m))
        depth_m = TIP_M - math.hypot(T[0, 3], beyond)
        if depth_m >= DEPTH_M:
            # The left one of two touches between the edges is misread.
            depth_m += misread_m * (beyond == 0.0 and T[1, 3] > 0.004)
            return T, contact(T, math.atan2(-beyond, -T[0, 3]), depth_m)
    return goal, None


def felt_side(push: PredictivePush, half_m: float, misread_m: float = 0.0) -> Array:
    """Let the push feel a side at x = 0 along y, and return where it stands opposite its middle."""
    T = sensor_at(DEPTH_M - TIP_M, 0.002)
    push.begin_approach(T)
    push.update(0.01, T, contact(T, 0.0, DEPTH_M))
    push.begin_sidestep(T)
    T_s_f: Array | None = None
    while (goal := push.next_goal(T, T_s_f)) is not None:
        T, T_s_f = felt(T, goal.T_base_sensor, half_m, misread_m) if goal.feels else (goal.T_base_sensor, None)
    return T


@pytest.mark.parametrize(("width_m", "at_least_deg", "at_most_deg"), [(0.04, 0.65, 0.9), (0.08, 0.3, 0.55)])
def test_what_a_loaded_contact_reads_counts_the_more_the_nearer_the_touches_of_a_side_were(
    width_m: float, at_least_deg: float, at_most_deg: float
) -> None:
    push = push_of(width_m)
    felt_side(push, 0.5 * width_m)
    misread_rad = math.radians(1.0)
    for k in range(300):
        # At rest, and from then on along the side's normal.
        T = sensor_at(DEPTH_M - TIP_M + 4e-5 * max(k - 100, 0), 0.0)
        progress = push.update(0.01, T, contact(T, misread_rad, DEPTH_M))
        if k < 100:
            assert progress.center.heading == pytest.approx(0.0, abs=1e-3)
    assert at_least_deg < math.degrees(progress.center.heading) < at_most_deg


def test_a_side_that_turns_out_to_lie_otherwise_moves_the_middle_between_its_edges() -> None:
    width_m = 0.044
    push = push_of(width_m)
    # 0.9 deg over 20 mm.
    felt_side(push, 0.5 * width_m, 0.3e-3)
    for k in range(300):
        T = sensor_at(DEPTH_M - TIP_M + 4e-5 * max(k - 100, 0), 0.0)
        progress = push.update(0.01, T, contact(T, 0.0, DEPTH_M))
    middle_m = push.estimator.model.middle_m
    assert middle_m is not None
    assert abs(middle_m) < 0.6e-3
    assert abs(progress.center.y) < 0.7e-3
