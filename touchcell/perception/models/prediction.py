"""Prediction of a trained model for one image, and the interface of all trained models."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.model_file import Header

SLIP_RATIO = 0.8
"""Ratio of shear to depth beyond which estimates of shear fall behind the motion, on public data: the skin slips."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """A Gaussian over the exponential coordinates of a contact, xi = log(T_s_f) (docs/glossary.md).

    Attributes:
        xi: (6,) mean [v, w], m and rad.
        covariance: (6, 6) of xi, m and rad.
        in_range: the mean lies in the model's training range (``Labels.cover``). Outside it, and out of contact, a
            prediction is unreliable.
        markers: fraction of the markers expected in view that were detected, for a marker model.
        tail_scale: factor of the covariance that makes it the scale of a Student-t with four degrees of freedom, as
            which large errors are likelier; None for a Gaussian.
        displacements: (m, 2) px of all markers from where they rest, for a marker model.
        refusal: why the image does not show the contact as the model's camera would; empty where it does.
    """

    xi: Array
    covariance: Array
    in_range: bool
    markers: float | None = None
    refusal: str = ""
    tail_scale: float | None = None
    displacements: Array | None = None

    @property
    def sigma(self) -> Array:
        """(6,) standard deviation of each component of xi, m and rad."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def pose_mm_deg(self) -> Array:
        """(6,) mean contact T_f_s: shear x, y and depth in mm, tilts alpha, beta and torsion gamma in degrees."""
        return se3.to_euler_mm_deg(se3.inverse(se3.exp(self.xi)))

    @property
    def slip_probability(self) -> float:
        """Probability that the skin has slipped: that the shear exceeds ``SLIP_RATIO`` of the depth."""
        return slip_probability(self.pose_mm_deg[:3], self.sigma_mm_deg[:3])

    @property
    def sigma_mm_deg(self) -> Array:
        """(6,) standard deviation of each component of xi, mm and degrees: along and about the sensor's axes."""
        sigma: Array = self.sigma * np.array([1e3] * 3 + [180.0 / np.pi] * 3)
        return sigma


def slip_probability(position: Array, sigma: Array) -> float:
    """Return the probability that the shear of a contact exceeds ``SLIP_RATIO`` of its depth.

    Args:
        position: (3,) shear x, y and depth.
        sigma: (3,) their standard deviations, in the same unit.
    """
    x, y, depth = position.tolist()
    sx, sy, sz = sigma.tolist()
    spread = math.hypot(math.hypot(sx, sy) / math.sqrt(2.0), SLIP_RATIO * sz)
    return 0.5 * (1.0 + math.erf((math.hypot(x, y) - SLIP_RATIO * depth) / (math.sqrt(2.0) * max(spread, 1e-9))))


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
