"""Simulated sequences: the skin shows the way that the sensor went, and not only where it is."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.contact import ContactLaw, contact_at
from touchcell.simulation.sequences import random_sequence

LAW = ContactLaw(torsion_grip=0.1)


def test_the_same_seed_gives_the_same_sequence_and_another_another() -> None:
    one, again, other = (random_sequence(120, seed, LAW) for seed in (1, 1, 2))
    assert (one.held == again.held).all()
    assert not np.allclose(one.T_f_s[:50], other.T_f_s[:50])


def test_until_the_skin_slips_it_holds_the_whole_motion_of_the_sensor() -> None:
    sequence = random_sequence(200, 3, LAW)
    stuck = int(sequence.slipping.argmax())
    assert stuck > 5
    np.testing.assert_allclose(sequence.held[:stuck], sequence.T_f_s[:stuck], atol=1e-9)


def test_depth_and_tilt_are_those_of_the_sensor_and_shear_is_within_what_the_depth_holds() -> None:
    sequence = random_sequence(300, 4, LAW)
    held, sensor = se3.to_euler_mm_deg(sequence.held), se3.to_euler_mm_deg(sequence.T_f_s)
    np.testing.assert_allclose(held[:, 2:5], sensor[:, 2:5], atol=1e-6)
    longest = np.array([1e3 * LAW.max_shear_m(1e-3 * z) for z in held[:, 2]])
    assert (np.hypot(held[:, 0], held[:, 1]) <= longest + 1e-6).all()


def test_slip_depends_on_the_way() -> None:
    sequence = random_sequence(600, 5, LAW)
    pressed_and_sheared = np.stack([contact_at(T, LAW).T_f_s for T in sequence.T_f_s])
    apart_mm = 1e3 * np.linalg.norm((sequence.held - pressed_and_sheared)[:, :2, 3], axis=1)
    assert np.median(apart_mm) > 0.5
    assert sequence.slipping.mean() == pytest.approx(0.5, abs=0.25)
