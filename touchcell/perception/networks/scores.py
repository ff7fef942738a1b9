"""Compare predictions with labels: errors, likelihood, coverage and reliability, over all images or a subset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.models.labels import CONTACT_NAMES, XI_UNITS, contact_from_xi, xi_from_contact

if TYPE_CHECKING:
    from touchcell.perception.models.prediction import Prediction

SCORE_NAMES = ("z_mm", "alpha_deg", "beta_deg", "x_mm", "y_mm", "gamma_deg")
"""Components of a contact in the order of tables: pose, then shear."""

SLIP_FREE_RATIO = 0.6
"""Contacts with a smaller ratio of shear to depth have not slipped. Measured on franka_tactip_1, where errors
in shear rise from a ratio of 0.6 on, and multiply beyond 1."""


@dataclass(frozen=True)
class Scores:
    """Labels of n images and the Gaussians that an estimator predicted for them.

    Everything probabilistic is about xi = log(T_s_f), under the full predicted covariance; the components of xi carry
    the names of the contact's, seen from the surface's side. Errors are the contact's own.

    Attributes:
        contact_mm_deg: (n, 6) labels, named as ``CONTACT_NAMES``.
        xi: (n, 6) means, m and rad.
        covariance: (n, 6, 6) of xi, m and rad.
        in_range: (n,) as reported by the estimator.
        tail_scale: factor of the covariances that makes them scales of a Student-t with four degrees of freedom, under
            which likelihoods are; None for Gaussians. Coverage is that of the Gaussian's intervals, which agree with
            a Student-t's of the same covariance at 95 %.
    """

    contact_mm_deg: Array
    xi: Array
    covariance: Array
    in_range: NDArray[np.bool_]
    tail_scale: float | None = None

    @classmethod
    def of(cls, contact_mm_deg: Array, predictions: Sequence[Prediction]) -> Scores:
        """Create scores from labels (n, 6) and the predictions for the same images."""
        return cls(
            contact_mm_deg,
            np.stack([prediction.xi for prediction in predictions]),
            np.stack([prediction.covariance for prediction in predictions]),
            np.array([prediction.in_range for prediction in predictions]),
            predictions[0].tail_scale if predictions else None,
        )

    def __len__(self) -> int:
        return len(self.xi)

    def subset(self, chosen: NDArray[np.bool_]) -> Scores:
        """Return the scores of the images for which ``chosen`` (n,) is True."""
        return Scores(
            self.contact_mm_deg[chosen],
            self.xi[chosen],
            self.covariance[chosen],
            self.in_range[chosen],
            self.tail_scale,
        )

    @property
    def slip_free(self) -> NDArray[np.bool_]:
        """(n,) True where the labelled shear is below ``SLIP_FREE_RATIO`` of the labelled depth."""
        shear = np.hypot(self.contact_mm_deg[:, 0], self.contact_mm_deg[:, 1])
        return np.asarray(shear < SLIP_FREE_RATIO * self.contact_mm_deg[:, 2])

    @property
    def predicted_mm_deg(self) -> Array:
        """(n, 6) predicted contacts, named as ``CONTACT_NAMES``."""
        return contact_from_xi(self.xi)

    @property
    def errors(self) -> Array:
        """(n, 6) predicted minus labelled contact, mm and degrees."""
        errors: Array = self.predicted_mm_deg - self.contact_mm_deg
        return errors

    @property
    def residuals(self) -> Array:
        """(n, 6) labelled minus predicted xi, mm and degrees."""
        residuals: Array = (xi_from_contact(self.contact_mm_deg) - self.xi) / XI_UNITS
        return residuals

    @property
    def sigma(self) -> Array:
        """(n, 6) predicted standard deviations of the components of xi, mm and degrees."""
        sigma: Array = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)) / XI_UNITS
        return sigma

    @property
    def standardised(self) -> Array:
        """(n, 6) residuals in predicted standard deviations; each standard normal if sigma is correct."""
        standardised: Array = self.residuals / self.sigma
        return standardised

    @property
    def nees(self) -> Array:
        """(n,) squared Mahalanobis distances of the labels; chi-squared of 6 degrees of freedom if consistent."""
        nees: Array = np.square(self._whitened()[0]).sum(axis=1)
        return nees

    @property
    def nll(self) -> Array:
        """(n,) negative log-likelihoods of the labelled xi, nats, with xi in mm and degrees."""
        whitened, log_sigmas = self._whitened()
        squares = np.square(whitened).sum(axis=1)
        if self.tail_scale is None:
            gaussian: Array = 0.5 * squares + log_sigmas + 3.0 * float(np.log(2.0 * np.pi))
            return gaussian
        # Multivariate Student-t with nu = 4 degrees of freedom in 6 dimensions (Kotz & Nadarajah 2004, eq. 1.1).
        constant = 3.0 * float(np.log(4.0 * np.pi * self.tail_scale)) + math.lgamma(2.0) - math.lgamma(5.0)
        nll: Array = constant + log_sigmas + 5.0 * np.log1p(squares / (4.0 * self.tail_scale))
        return nll

    def mae(self) -> dict[str, float]:
        """Return the mean absolute error of each component of the contact, in the order of ``SCORE_NAMES``."""
        return _named(np.abs(self.errors).mean(axis=0))

    def coverage(self, probability: float) -> dict[str, float]:
        """Return, per component, the fraction of labels in the predicted central interval of that probability."""
        return _named((np.abs(self.standardised) <= _quantile(probability)).mean(axis=0))

    def joint_coverage(self, probability: float) -> float:
        """Return the fraction of labels in the predicted ellipsoid of that probability, all six components together."""
        # The cumulative distribution of chi-squared with 6 degrees of freedom has a closed form.
        half = 0.5 * self.nees
        return float((1.0 - np.exp(-half) * (1.0 + half + 0.5 * half**2) <= probability).mean())

    def reliability(self, probabilities: Sequence[float]) -> dict[str, list[float]]:
        """Return ``coverage`` at each probability, by component: a calibrated estimator's equal the probabilities."""
        rows = [self.coverage(probability) for probability in probabilities]
        return {name: [row[name] for row in rows] for name in SCORE_NAMES}

    def _whitened(self) -> tuple[Array, Array]:
        """(n, 6) residuals in which the prediction is standard normal, and (n,) logarithms of its volume."""
        factor = np.linalg.cholesky(self.covariance / np.outer(XI_UNITS, XI_UNITS))
        whitened = np.linalg.solve(factor, self.residuals[..., None])[..., 0]
        return whitened, np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)


def _named(values: Array) -> dict[str, float]:
    return {name: float(values[CONTACT_NAMES.index(name)]) for name in SCORE_NAMES}


def _quantile(probability: float) -> float:
    """Return the half width, in standard deviations, of a normal distribution's central interval."""
    return NormalDist().inv_cdf(0.5 + 0.5 * probability)
