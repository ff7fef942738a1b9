"""How much a model misreads the depth on a surface that rests, from the arm's own motion."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.control.resting_depth import RestingDepth
from touchcell.geometry.types import Array

FRAME_NS = 33_000_000
AT_M = 5e-3


def at(x_m: float, z_m: float, tilt_rad: float = 0.0) -> Array:
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    return np.array([[c, 0.0, s, x_m], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, z_m], [0.0, 0.0, 0.0, 1.0]])


class Following:
    """A sensor along z that touches a plane 5 mm ahead whose slope over x is given; the model reads too little."""

    def __init__(self, slope: float = 0.0) -> None:
        self.zero = RestingDepth()
        self._slope = slope
        self._seq = 0

    def go(self, x_m: float, z_m: float, misread_m: float) -> None:
        T = at(x_m, z_m)
        self.zero.moved(self._seq * FRAME_NS, T)
        inwards = np.array([-self._slope, 0.0, 1.0]) / np.hypot(1.0, self._slope)
        depth_m = float(inwards @ (T[:3, 3] - np.array([0.0, 0.0, AT_M])))
        T_s_f = at(0.0, 0.0, -np.arctan(self._slope))
        T_s_f[:3, 3] = -(depth_m + misread_m) * inwards
        self.zero.saw(self._seq * FRAME_NS, self._seq, max(0.004, 90.0 * depth_m), T_s_f if depth_m > 0.3e-3 else None)
        self._seq += 1

    def touch(self, misread_m: float) -> None:
        for k in range(20):
            self.go(0.0, 0.33e-3 * k, misread_m)
        for _ in range(12):
            self.go(0.0, 0.33e-3 * 19, misread_m)


def test_the_error_is_that_at_the_depth_to_which_the_sensor_is_pressed() -> None:
    following = Following()
    following.touch(-0.2e-3)
    assert following.zero.error_m == pytest.approx(-0.2e-3, abs=0.05e-3)
    for k in range(20):
        following.go(0.0, 0.33e-3 * 19 + 0.1e-3 * k, -0.2e-3 - 0.02e-3 * k)
    for _ in range(6):
        following.go(0.0, 0.33e-3 * 19 + 1.9e-3, -0.6e-3)
    assert following.zero.error_m == pytest.approx(-0.6e-3, abs=0.05e-3)


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_the_error_while_sliding_is_the_one_that_stays(slope: float) -> None:
    following = Following(slope)
    following.touch(-0.4e-3)
    for k in range(1, 16):
        # Along the surface, at 0.7 mm a frame; dragged skin is read otherwise.
        following.go(0.7e-3 * k, 0.33e-3 * 19 + slope * 0.7e-3 * k, 0.1e-3)
    assert following.zero.ended
    assert following.zero.error_m == pytest.approx(0.1e-3, abs=0.06e-3)


def test_a_soft_surface_leaves_the_error_as_it_was_at_the_touch() -> None:
    following = Following()
    following.touch(-0.2e-3)
    for k in range(1, 20):
        # It gives way by half of what the arm advances.
        following.go(0.0, 0.33e-3 * 19 + 0.1e-3 * k, -0.2e-3 - 0.05e-3 * k)
    for _ in range(3):
        following.go(0.0, 0.33e-3 * 19 + 1.9e-3, -0.2e-3 - 0.95e-3)
    assert following.zero.ended
    assert following.zero.error_m == pytest.approx(-0.2e-3, abs=0.05e-3)


def test_frames_without_a_valid_contact_are_left_out() -> None:
    following = Following()
    following.touch(-0.3e-3)
    before = following.zero.error_m
    following.zero.saw(10**10, 999, 0.1, None)
    assert following.zero.error_m == before
