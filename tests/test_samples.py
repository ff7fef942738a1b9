import numpy as np

from drivers.simulation.contact import ContactLaw
from drivers.simulation.samples import Variation, random_poses, training_set
from drivers.simulation.tip import Tip
from geometry import se3


def test_the_same_seed_gives_the_same_set_and_another_gives_another() -> None:
    first, second, other = (list(training_set(20, seed)) for seed in (1, 1, 2))
    for (image, T), (again, T_again) in zip(first, second, strict=True):
        np.testing.assert_array_equal(image, again)
        np.testing.assert_array_equal(T, T_again)
    assert (first[0][0] != other[0][0]).any()


def test_images_are_as_asked_and_as_many() -> None:
    made = list(training_set(5, 0, size_px=(96, 64), crop=(111, 27, 541, 457)))
    assert len(made) == 5
    for image, T in made:
        assert image.shape == (64, 96)
        assert image.dtype == np.uint8
        assert T.shape == (4, 4)


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


def test_labels_are_what_is_left_after_slip() -> None:
    law = ContactLaw()
    labels = np.stack([T for _, T in training_set(400, 3)])
    for T in labels:
        depth = T[2, 3]
        assert np.hypot(T[0, 3], T[1, 3]) <= law.max_shear_m(depth) + 1e-12
        assert abs(np.arctan2(T[1, 0], T[0, 0])) <= law.max_torsion_rad(depth) + 1e-12
    shallow = labels[labels[:, 2, 3] < 0.002]
    assert np.hypot(shallow[:, 0, 3], shallow[:, 1, 3]).max() < 0.0013
    deep = labels[labels[:, 2, 3] > 0.0045]
    assert np.hypot(deep[:, 0, 3], deep[:, 1, 3]).max() > 0.004


def test_without_variation_the_image_shows_the_label() -> None:
    still = Variation(0, 0, 0, 0, 0, 0, 0)
    tip = Tip()
    for image, T in training_set(4, 5, size_px=(445, 440), variation=still):
        u, v = np.round(tip.pixels(T) - [105.0, 20.0]).astype(int).T
        seen = (u >= 0) & (u < 445) & (v >= 0) & (v < 440)
        assert (image[v[seen], u[seen]] == 255).all()
        assert image.mean() / 255 == np.clip(image.mean() / 255, 0.15, 0.25)


def test_sensors_differ_within_a_set() -> None:
    still = Variation(marker_px=0, disc_radius=0, missing=0, noise=0)
    images = [image.astype(float) for image, _ in training_set(33, 0, variation=still)]
    assert np.abs(images[0] - images[-1]).mean() > 1.0
