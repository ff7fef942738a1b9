"""What a trained model says about one image, and what every trained model can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.model_file import Header

RANGE_TOLERANCE = 0.05
"""How far, in label half-ranges, a prediction may lie outside the taught range and still count as inside."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """A Gaussian over the exponential coordinates of a contact, xi = log(T_s_f) (SPEC part 2).

    Attributes:
        xi: (6,) mean [v, w], m and rad.
        covariance: (6, 6) of xi, m and rad.
        in_range: the mean lies in the range of labels that the model was taught. Outside it, and out of contact, a
            prediction means little.
        markers: share of the markers expected in view that were seen, where the model looks for markers.
    """

    xi: Array
    covariance: Array
    in_range: bool
    markers: float | None = None

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
        """Of the model file."""
        ...

    @property
    def reference(self) -> ImageArray | None:
        """Preprocessed image out of contact, or None when nobody took one."""
        ...

    def reduce(self, image: ImageArray) -> ImageArray:
        """The model's preprocessing. Raises ImageError."""
        ...

    def predict(self, image: ImageArray) -> Prediction:
        """Contact in one camera image. Raises ImageError."""
        ...

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Contact in an image that ``reduce`` made."""
        ...
