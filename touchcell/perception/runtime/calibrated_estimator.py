"""Use an estimator with another camera than the one it was trained with."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from touchcell.geometry.types import ImageArray
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.model_file import Header
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.models.preprocessing import Preprocessing

if TYPE_CHECKING:
    from touchcell.perception.models.prediction import ContactEstimator


class CalibratedEstimator:
    """An estimator whose camera images are transformed to those of the camera it was trained with.

    A marker estimator has its discs transformed, without loss of accuracy; for any other the images are warped.
    """

    def __init__(self, estimator: ContactEstimator, change: CameraChange) -> None:
        from touchcell.perception.markers.estimator import MarkerEstimator

        self._estimator = estimator
        self._warps = not isinstance(estimator, MarkerEstimator)
        self._change = change if self._warps else in_crop(change, estimator.header.preprocessing)
        if isinstance(estimator, MarkerEstimator):
            estimator.change = self._change

    @property
    def header(self) -> Header:
        """Header of the model file."""
        return self._estimator.header

    @property
    def reference(self) -> ImageArray | None:
        """The model's image out of contact, as ``reduce`` produces it for this sensor."""
        reference = self._estimator.reference
        return reference if reference is None or self._warps else self._change.undone(reference)

    def reduce(self, image: ImageArray) -> ImageArray:
        """Apply the model's preprocessing to the image as seen by the model's own camera. Raises ImageError."""
        return self._estimator.reduce(self._change.image(image) if self._warps else image)

    def predict(self, image: ImageArray) -> Prediction:
        """Estimate the contact in one camera image. Raises ImageError."""
        return self.predict_reduced(self.reduce(image))

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Estimate the contact in an image returned by ``reduce``."""
        prediction = self._estimator.predict_reduced(reduced)
        turn_deg = self.header.label_turn_deg
        return prediction if turn_deg == 0.0 else turned(prediction, -turn_deg)


def turned(prediction: Prediction, angle_deg: float) -> Prediction:
    """Return a prediction with the axes of sensor and surface rotated about the sensor's z axis."""
    turn = np.deg2rad(angle_deg)
    G = np.eye(6)
    for first in (0, 3):
        G[first : first + 2, first : first + 2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    return replace(prediction, xi=G @ prediction.xi, covariance=G @ prediction.covariance @ G.T)


def in_crop(change: CameraChange, preprocessing: Preprocessing) -> CameraChange:
    """Return the same change in the pixels of the crop."""
    u, v = change.centre_px
    return change.model_copy(update={"centre_px": (u - preprocessing.region.left, v - preprocessing.region.top)})
