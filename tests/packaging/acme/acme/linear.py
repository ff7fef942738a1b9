"""An architecture: the contact is linear in the pixels."""

from typing import Literal

import numpy as np

from touchcell.geometry.types import ImageArray
from touchcell.perception.models.architecture_spec import ArchitectureConfig, ArchitectureSpec
from touchcell.perception.models.model_file import Model
from touchcell.perception.models.prediction import Prediction


class LinearConfig(ArchitectureConfig):
    """The architecture in the header of a model file."""

    kind: Literal["acme_linear"] = "acme_linear"

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        height, width = self.input_size
        return {"weight": (6, height * width), "bias": (6,)}


class Linear:
    """A model of this kind, ready to predict."""

    def __init__(self, model: Model) -> None:
        self.header, self.reference = model.header, model.reference
        self._weight, self._bias = model.tensors["weight"], model.tensors["bias"]

    def reduce(self, image: ImageArray) -> ImageArray:
        return self.header.preprocessing.reduce(image)

    def predict(self, image: ImageArray) -> Prediction:
        return self.predict_reduced(self.reduce(image))

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        mean = (self._weight @ (reduced.ravel() / np.float32(255)) + self._bias).astype(np.float64)
        xi, covariance = self.header.labels.xi_gaussian(mean, self.header.calibrated(np.ones(6), mean))
        return Prediction(xi, covariance, in_range=bool(np.all(np.abs(mean) <= 1.0)))


SPEC = ArchitectureSpec("acme_linear", "a contact linear in the pixels", LinearConfig, Linear)
