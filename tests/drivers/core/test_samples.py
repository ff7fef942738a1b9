import numpy as np

from touchcell.geometry import se3
from touchcell.perception.contact_poses import random_poses
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.samples import Variation, contacts
from touchcell.simulation.tip import Tip


def test_the_same_seed_gives_the_same_set_and_another_gives_another() -> None:
    first, second, other = (list(contacts(20, seed)) for seed in (1, 1, 2))
    assert len(first) == 20
    for made, again in zip(first, second, strict=True):
        np.testing.assert_array_equal(made.pixels, again.pixels)
        np.testing.assert_array_equal(made.T_f_s, again.T_f_s)
        assert made.disc_radius_px == again.disc_radius_px
    assert (first[0].T_f_s != other[0].T_f_s).any()


def test_poses_fill_the_ranges_of_the_public_data_and_no_more() -> None:
    poses = se3.to_euler_mm_deg(random_poses(4000, np.random.default_rng(0)))
    shear, depth, tilt, gamma = poses[:, :2], poses[:, 2], poses[:, 3:5], poses[:, 5]
    for values, lowest, highest in ((depth, 0.5, 6.0), (gamma, -5.0, 5.0)):
        assert lowest <= values.min() < lowest + 0.02
        assert highest - 0.02 < values.max() <= highest
    for disc, radius in ((shear, 5.0), (tilt, 25.0)):
        length = np.linalg.norm(disc, axis=1) / radius
        assert length.max() <= 1.0
        # Even over a disc: half of the points lie within 1/sqrt(2) of its radius.
        assert abs((length < np.sqrt(0.5)).mean() - 0.5) < 0.03
        assert np.abs(disc.mean(axis=0)).max() < 0.03 * radius


def test_labels_are_the_contacts_after_slip() -> None:
    law = ContactLaw()
    labels = np.stack([contact.T_f_s for contact in contacts(400, 3)])
    for T in labels:
        depth = T[2, 3]
        assert np.hypot(T[0, 3], T[1, 3]) <= law.max_shear_m(depth) + 1e-12
        assert abs(np.arctan2(T[1, 0], T[0, 0])) <= law.max_torsion_rad(depth) + 1e-12
    shallow = labels[labels[:, 2, 3] < 0.002]
    assert np.hypot(shallow[:, 0, 3], shallow[:, 1, 3]).max() < 0.0013
    deep = labels[labels[:, 2, 3] > 0.0045]
    assert np.hypot(deep[:, 0, 3], deep[:, 1, 3]).max() > 0.004


def test_without_variation_the_markers_are_those_of_the_default_sensor() -> None:
    tip = Tip()
    for contact in contacts(4, 5, variation=Variation(0, 0, 0, 0, 0, 0)):
        np.testing.assert_allclose(contact.pixels, tip.pixels(contact.T_f_s), atol=1e-9)
        assert contact.disc_radius_px == tip.parameters.disc_radius_px


def test_markers_go_missing_at_the_given_rate() -> None:
    seen = sum(len(contact.pixels) for contact in contacts(200, 6, variation=Variation(missing=0.1)))
    assert abs(1 - seen / (200 * 331) - 0.1) < 0.01


def test_sensors_differ_within_a_set() -> None:
    still = Variation(marker_px=0, disc_radius=0, missing=0)
    tip = Tip()
    offsets = [np.abs(each.pixels - tip.pixels(each.T_f_s)).mean() for each in contacts(33, 0, variation=still)]
    assert offsets[0] > 0.2
    assert abs(offsets[0] - offsets[-1]) > 0.01
