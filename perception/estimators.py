"""Any trained model by its file alone."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from geometry.types import ImageArray
from perception.inference import ContactModel, Prediction
from perception.model_file import Header, Model, load_model


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


def load_estimator(path: Path) -> ContactEstimator:
    """Open a model file of any kind.

    Raises:
        ModelError: as ``model_file.load_model``.
    """
    return estimator_of(load_model(path))


def estimator_of(model: Model) -> ContactEstimator:
    """The estimator that a model of any kind describes."""
    if model.header.architecture.kind == "markers":
        from perception.marker_estimator import MarkerEstimator

        return MarkerEstimator(model)
    return ContactModel(model)
