from dataclasses import replace

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.perception.calibration.least_squares import robust_fit
from touchcell.perception.calibration.marked_data import MarkedContacts
from touchcell.perception.contact_poses import random_poses
from touchcell.perception.errors import TrainingError
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_fit import Sensor, fit_tip

TRUE = Sensor(
    replace(
        TipParameters(),
        image_rotation_rad=1.1,
        layout_phase_rad=0.05,
        focal_px=530.0,
        centre_px=(320.0, 250.0),
        camera_tilt_rad=(0.02, -0.01),
        dent_follow=1.15,
        rock=-0.9,
    ),
    MountModel(
        offset_m=(0.5e-3, 2.0e-3), depth_m=0.2e-3, level_rad=(0.01, 0.0), slip_at_1mm_m=0.25e-3, slip_exponent=2.1
    ),
)
REFERENCE = Tip(TRUE.tip).pixels(np.eye(4))


def contacts(n: int, seed: int, sensor: Sensor = TRUE) -> MarkedContacts:
    rng = np.random.default_rng(seed)
    poses = random_poses(n, rng)
    pixels = sensor.pixels(poses) + rng.normal(0.0, 0.3, (n, 331, 2))
    seen = rng.random((n, 331)) > 0.02
    pixels[~seen] = np.nan_to_num(pixels[~seen]) + 40.0
    return MarkedContacts(poses, pixels, seen)


def test_twenty_contacts_determine_camera_mount_and_skin() -> None:
    calls: list[tuple[int, int]] = []
    fitted = fit_tip(contacts(24, 1), REFERENCE, 10, progress=lambda done, total: calls.append((done, total)))
    held_out = contacts(40, 2)
    assert np.nanmean(Sensor(TipParameters(), MountModel()).errors(held_out)) > 10.0
    assert np.nanmean(fitted.errors(held_out)) < 0.8
    assert np.isnan(fitted.errors(held_out)).sum() == (~held_out.seen).sum()
    assert fitted.tip.image_rotation_rad == pytest.approx(1.1, abs=0.03)
    np.testing.assert_allclose(fitted.rig.offset_m, TRUE.rig.offset_m, atol=0.4e-3)
    assert calls[-1][0] >= 5


def test_a_mirrored_image_is_reported() -> None:
    made = contacts(24, 3)
    mirrored = se3.to_euler_mm_deg(made.T_f_s) * np.array([-1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
    wrong = MarkedContacts(se3.from_euler_mm_deg(mirrored), made.pixels, made.seen)
    with pytest.raises(TrainingError, match="no orientation"):
        fit_tip(wrong, REFERENCE, 10)


def test_a_handful_of_contacts_is_too_little() -> None:
    with pytest.raises(TrainingError, match="7 contacts"):
        fit_tip(contacts(7, 1), REFERENCE, 10)


def test_robust_fit_finds_a_line_among_outliers_and_keeps_to_bounds() -> None:
    t = np.linspace(0.0, 1.0, 50)
    y = 2.0 * t - 1.0
    y[::10] += 50.0
    line = {"low": np.full(2, -10.0), "high": np.full(2, 10.0), "prior": 1e-6, "soft": 0.1}
    found = robust_fit(lambda x: x[0] * t + x[1] - y, np.zeros(2), np.ones(2), **line)
    np.testing.assert_allclose(found, [2.0, -1.0], atol=0.05)
    line["high"] = np.array([1.5, 10.0])
    assert robust_fit(lambda x: x[0] * t + x[1] - y, np.zeros(2), np.ones(2), **line)[0] == pytest.approx(1.5)
    line |= {"high": np.full(2, 10.0), "prior": 1e4}
    np.testing.assert_allclose(robust_fit(lambda x: x[0] * t + x[1] - y, np.zeros(2), np.ones(2), **line), 0, atol=1e-3)
