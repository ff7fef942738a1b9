from __future__ import annotations

import numpy as np
import pytest

from touchcell.perception.models.labels import CONTACT_NAMES, XI_UNITS, xi_from_contact
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.networks.scores import SCORE_NAMES, Scores

CONTACT = np.array([1.0, -0.5, 3.0, 5.0, -8.0, 1.0])
"""x, y, z mm, alpha, beta, gamma deg."""

L = np.tril(np.random.default_rng(3).normal(0.0, 0.4, (6, 6)), -1) + np.diag([0.5, 0.7, 0.1, 0.6, 0.8, 1.5])
COVARIANCE = np.outer(XI_UNITS, XI_UNITS) * (L @ L.T)


def calibrated(n: int) -> Scores:
    """Predictions whose errors have exactly the predicted distribution."""
    rng = np.random.default_rng(0)
    xi = xi_from_contact(CONTACT) - rng.normal(size=(n, 6)) @ L.T * XI_UNITS
    return Scores(np.tile(CONTACT, (n, 1)), xi, np.tile(COVARIANCE, (n, 1, 1)), np.ones(n, bool))


def test_errors_are_of_the_contact() -> None:
    off = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
    predictions = [Prediction(xi_from_contact(CONTACT + sign * off), COVARIANCE, True) for sign in (1.0, -1.0)]
    scores = Scores.of(np.tile(CONTACT, (2, 1)), predictions)
    np.testing.assert_allclose(scores.errors, [off, -off], atol=1e-9)
    assert list(scores.mae()) == list(SCORE_NAMES)
    for name, error in scores.mae().items():
        assert error == pytest.approx(abs(off[CONTACT_NAMES.index(name)]), abs=1e-9)


def test_likelihood_is_that_of_the_full_covariance() -> None:
    scores = calibrated(50)
    C = L @ L.T
    for residual, nll, nees in zip(scores.residuals, scores.nll, scores.nees, strict=True):
        square = residual @ np.linalg.inv(C) @ residual
        assert nees == pytest.approx(square)
        assert nll == pytest.approx(0.5 * (square + np.log(np.linalg.det(2.0 * np.pi * C))))
    np.testing.assert_allclose(scores.sigma, np.tile(np.sqrt(np.diag(C)), (50, 1)))


def test_calibrated_predictions_have_the_nominal_coverage() -> None:
    scores = calibrated(4000)
    shares = [0.1, 0.5, 0.68, 0.95]
    for found in scores.reliability(shares).values():
        np.testing.assert_allclose(found, shares, atol=0.025)
    assert scores.coverage(0.68) == {name: found[2] for name, found in scores.reliability(shares).items()}
    assert scores.joint_coverage(0.95) == pytest.approx(0.95, abs=0.015)
    assert scores.nees.mean() == pytest.approx(6.0, abs=0.2)
    overconfident = Scores(scores.contact_mm_deg, scores.xi, 0.25 * scores.covariance, scores.in_range)
    assert max(overconfident.coverage(0.95).values()) < 0.72
    assert overconfident.joint_coverage(0.95) < 0.5


def test_slip_free_is_decided_by_the_labels() -> None:
    scores = calibrated(4)
    contact = scores.contact_mm_deg.copy()
    contact[:, :3] = [[1.0, 1.0, 3.0], [3.0, 0.0, 3.0], [0.0, -0.5, 1.0], [0.0, -0.7, 1.0]]
    scores = Scores(contact, scores.xi, scores.covariance, np.array([True, True, False, True]))
    assert scores.slip_free.tolist() == [True, False, True, False]
    free = scores.subset(scores.slip_free)
    assert len(free) == 2
    assert free.in_range.tolist() == [True, False]
    np.testing.assert_array_equal(free.errors, scores.errors[[0, 2]])
