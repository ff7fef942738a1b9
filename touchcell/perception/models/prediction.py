"""Prediction of a trained model for one image, and the interface of all trained models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.model_file import Header

RANGE_TOLERANCE = 0.05
"""Tolerance, in label half-ranges, by which a prediction may exceed the training range and still count as inside."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """A Gaussian over the exponential coordinates of a contact, xi = log(T_s_f) (docs/glossary.md).

    Attributes:
        xi: (6,) mean [v, w], m and rad.
        covariance: (6, 6) of xi, m and rad.
        in_range: the mean lies in the model's training range of labels. Outside it, and out of contact, a prediction is
            unreliable.
        markers: fraction of the markers expected in view that were detected, for a marker model.
        refusal: why the image does not show the contact as the model's camera would; empty where it does.
    """

    xi: Array
    covariance: Array
    in_range: bool
    markers: float | None = None
    refusal: str = ""

    @property
    def sigma(self) -> Array:
        """(6,) standard deviation of each component of xi, m and rad."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def pose_mm_deg(self) -> Array:
        """(6,) mean contact T_f_s: shear x, y and depth in mm, tilts alpha, beta and torsion gamma in degrees."""
        return se3.to_euler_mm_deg(se3.inverse(se3.exp(self.xi)))

    @property
    def sigma_mm_deg(self) -> Array:
        """(6,) standard deviation of each component of xi, mm and degrees: along and about the sensor's axes."""
        sigma: Array = self.sigma * np.array([1e3] * 3 + [180.0 / np.pi] * 3)
        return sigma


class ContactEstimator(Protocol):
    """A trained model, ready to predict."""

    @property
    def header(self) -> Header:
        """Header of the model file."""
        ...

    @property
    def reference(self) -> ImageArray | None:
        """Preprocessed image out of contact, or None when there is none."""
        ...

    def reduce(self, image: ImageArray) -> ImageArray:
        """Apply the model's preprocessing. Raises ImageError."""
        ...

    def predict(self, image: ImageArray) -> Prediction:
        """Estimate the contact in one camera image. Raises ImageError."""
        ...

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Estimate the contact in an image returned by ``reduce``."""
        ...
