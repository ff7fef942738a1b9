"""Random tips of one kind."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import load_tip
from touchcell.simulation.tip_spread import TipSpread

PRESSED = se3.from_euler_mm_deg([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])[None]


def drawn(count: int) -> list[TipParameters]:
    rng, spread = np.random.default_rng(5), TipSpread()
    return [spread.draw(rng) for _ in range(count)]


def test_all_show_the_lattice_at_rest_and_differ_in_how_they_deform() -> None:
    tips = [TipParameters(), load_tip("franka_tactip_1").tip, *drawn(20)]
    rest = np.array([(tip := Tip(each)).project(tip.rest_positions) for each in tips])
    moved = np.array([Tip(each).pixels(PRESSED)[0] for each in tips]) - rest
    assert np.linalg.norm(rest - rest[0], axis=2).mean(axis=1).max() < 3.0
    sizes = np.linalg.norm(moved, axis=2).mean(axis=1)
    assert sizes.std() > 0.03 * sizes.mean()


def test_they_lie_about_both_sensors_that_are_known() -> None:
    one, other = TipParameters(), load_tip("franka_tactip_1").tip
    widths = np.array([each.shear_width_rad for each in drawn(200)])
    low, high = sorted((one.shear_width_rad, other.shear_width_rad))
    assert widths.min() < low < high < widths.max()
    assert np.median(widths) == pytest.approx(0.5 * (low + high), rel=0.1)


def test_no_share_of_the_skin_is_negative() -> None:
    signed = {"rock", "centre_px", "image_rotation_rad", "layout_phase_rad", "camera_tilt_rad"}
    for tip in drawn(200):
        for each in fields(tip):
            assert each.name in signed or getattr(tip, each.name) >= 0.0
