"""Gaussians over contacts, aligned with their shear, as Gaussians over xi."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.perception.models.test_model_file import make_model
from touchcell.perception.models.labels import XI_UNITS, contact_from_xi, shear_direction, xi_from_contact, xi_gaussian
from touchcell.perception.models.model_file import Labels
from touchcell.perception.networks.sigma_scaling import OTHER_SESSIONS, calibrate, calibration

LABELS = Labels.of_contacts((-5.0, -4.0, 0.5, -25.0, -24.0, -5.0), (5.0, 4.4, 6.0, 25.0, 26.0, 5.0))
OTHER = Labels(low=(-0.005, -0.005, -0.006, -0.4, -0.4, -0.1), high=(0.005, 0.005, 0.0, 0.4, 0.4, 0.1))

means = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array)
sigmas = st.lists(st.floats(1e-3, 1.0), min_size=6, max_size=6).map(np.array)


@given(means)
def test_small_changes_of_a_contact_are_small_changes_of_xi(mean: np.ndarray) -> None:
    contact = LABELS.contacts(mean)
    jacobian = np.empty((6, 6))
    for i in range(6):
        step = 1e-4 * np.eye(6)[i]
        jacobian[:, i] = (xi_from_contact(contact + step) - xi_from_contact(contact - step)) / 2e-4
    covariance = np.diag([0.3, 0.2, 0.1, 0.5, 0.7, 1.5]) ** 2
    xi, found = xi_gaussian(contact, covariance)
    np.testing.assert_allclose(contact_from_xi(xi), contact, atol=1e-9)
    scale = np.outer(XI_UNITS, XI_UNITS)
    np.testing.assert_allclose(found / scale, jacobian @ covariance @ jacobian.T / scale, atol=1e-6)


@given(means, sigmas)
def test_sigmas_are_those_along_and_across_the_shear(mean: np.ndarray, sigma: np.ndarray) -> None:
    """Residuals drawn from the predicted covariance have, ``aligned``, the sigmas that were put in."""
    contact = LABELS.contacts(mean)
    along = shear_direction(contact)
    axes = np.eye(6)
    axes[:2, :2] = [along, [-along[1], along[0]]]
    expected = axes.T @ np.diag((sigma * LABELS.sigma_unit) ** 2) @ axes
    xi, covariance = LABELS.xi_gaussian(mean, sigma)
    np.testing.assert_allclose(covariance, xi_gaussian(contact, expected)[1], rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(xi, xi_from_contact(contact))
    steps = axes / LABELS.half_range
    aligned = np.stack([LABELS.aligned(step, mean) for step in steps])
    np.testing.assert_allclose(aligned, np.diag(1.0 / LABELS.sigma_unit), atol=1e-12)


def test_labels_of_either_kind_round_trip() -> None:
    xi = xi_from_contact(np.random.default_rng(0).uniform(LABELS.low, LABELS.high, (20, 6)))
    for labels in (LABELS, OTHER):
        np.testing.assert_allclose(labels.contacts(labels.targets(xi)), contact_from_xi(xi), atol=1e-9)
        found, covariance = labels.xi_gaussian(labels.targets(xi), np.full((20, 6), 0.1))
        np.testing.assert_allclose(found, xi, atol=1e-12)
        one = labels.xi_gaussian(labels.targets(xi)[7], np.full(6, 0.1))[1]
        np.testing.assert_allclose(covariance[7], one, rtol=1e-12)
    residual = np.arange(6.0)
    np.testing.assert_array_equal(OTHER.aligned(residual, residual), residual)
    np.testing.assert_allclose(
        OTHER.xi_gaussian(np.zeros(6), np.full(6, 0.5))[1], np.diag((0.5 * OTHER.half_range) ** 2)
    )


@pytest.mark.parametrize(
    ("mean", "sigma", "covered"),
    [
        ([0.9, 0.3, 0.0, 0.0, 0.0, 1.04], [0.0] * 6, True),
        ([0.9, 0.3, 0.0, 0.0, 0.0, 1.1], [0.0] * 6, False),
        ([0.9, 0.3, 0.0, 0.0, 0.0, 1.1], [0.0, 0.0, 0.0, 0.0, 0.0, 0.12], True),
        ([0.0, 0.0, 0.0, 0.0, 0.0, -1.2], [9.0] * 6, False),
        # The first sigma is along the shear, here along y.
        ([0.0, 1.1, 0.0, 0.0, 0.0, 0.0], [0.12, 0.0, 0.0, 0.0, 0.0, 0.0], True),
        ([0.0, 1.1, 0.0, 0.0, 0.0, 0.0], [0.0, 0.12, 0.0, 0.0, 0.0, 0.0], False),
    ],
)
def test_estimates_at_the_border_of_the_range_may_scatter_beyond_it(
    mean: list[float], sigma: list[float], covered: bool
) -> None:
    assert LABELS.cover(np.array(mean), np.array(sigma)) == covered


def test_a_contact_without_shear_has_a_direction() -> None:
    np.testing.assert_array_equal(shear_direction(np.zeros((2, 6))), [[1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(shear_direction(np.array([3.0, -4.0, 1, 0, 0, 0])), [0.6, -0.8])


def test_calibration_finds_scale_and_power() -> None:
    rng = np.random.default_rng(0)
    sigma = np.exp(rng.normal(-3.0, 0.7, (20_000, 6)))
    residual = rng.normal(size=sigma.shape) * 2.0 * sigma**0.8
    scale, power = calibrate(residual, sigma)
    np.testing.assert_allclose(power, 0.8, atol=0.04)
    np.testing.assert_allclose(scale * 0.05**power, 2.0 * 0.05**0.8, rtol=0.03)
    scale, power = calibrate(residual, np.ones_like(sigma))
    np.testing.assert_array_equal(power, 1.0)
    assert scale[0] == pytest.approx(np.sqrt((residual[:, 0] ** 2).mean()))


def test_a_calibration_adds_what_other_sessions_have() -> None:
    """Sigmas of slipping contacts grow along the shear and in torsion; those of others by the offsets alone."""
    rng = np.random.default_rng(1)
    sigma = np.full((4000, 6), 0.02)
    mean = np.zeros((4000, 6))
    free, slips = mean[:1].copy(), mean[:1].copy()
    slips[0, [0, 2, 5]] = 0.8, -0.8, 0.5
    fields = calibration(LABELS, mean, sigma, mean + rng.normal(0.0, 0.02, (4000, 6)))
    header = make_model().header.model_copy(update={**fields, "labels": LABELS})
    more = np.square(header.calibrated(np.full((1, 6), 0.02), slips)) - np.square(
        header.calibrated(np.full((1, 6), 0.02), free)
    )
    contact = LABELS.contacts(slips)[0]
    assert contact[0] > 2 * OTHER_SESSIONS.free * contact[2]
    expected = np.zeros(6)
    expected[0] = OTHER_SESSIONS.slip * np.hypot(*contact[:2])
    expected[5] = OTHER_SESSIONS.torsion_slip * contact[5]
    np.testing.assert_allclose(more[0], np.square(expected / LABELS.sigma_unit), atol=1e-12)
    own = header.calibrated(np.full((1, 6), 0.02), free)[0]
    offset = np.array(OTHER_SESSIONS.offset_mm_deg) / LABELS.sigma_unit
    validated = header.model_copy(update={"session": None}).calibrated(np.full(6, 0.02))
    np.testing.assert_allclose(validated, 0.02, rtol=0.15)
    np.testing.assert_allclose(own, np.hypot(validated, offset))
    np.testing.assert_allclose(header.calibrated(np.full(6, 0.02)), own)


@pytest.mark.parametrize("shear", [0.0, 0.5, 3.0, 9.0])
def test_one_contact_has_the_direction_and_variance_that_many_have(shear: float) -> None:
    contacts = np.array([[0.6 * shear, -0.8 * shear, 2.5, 5.0, -4.0, 7.0], [0.0, 0.0, -0.1, 1.0, 2.0, -3.0]])
    for one, direction, variance in zip(
        contacts, shear_direction(contacts), OTHER_SESSIONS.variance(contacts), strict=True
    ):
        np.testing.assert_allclose(shear_direction(one), direction, atol=1e-15)
        np.testing.assert_allclose(OTHER_SESSIONS.variance(one), variance, rtol=1e-14)
