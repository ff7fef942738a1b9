"""Contact pose and shear from one image, in a running cell: ONNX Runtime on one thread, no PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Frame, Stamped
from geometry.types import Array, ImageArray
from perception.graph import IMAGES, OUTPUTS, onnx_model
from perception.model_file import Header, Model, load_model
from perception.preprocessing import scale

RANGE_TOLERANCE = 0.05
"""How far, in label half-ranges, a prediction may lie outside the taught range and still count as inside."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """A Gaussian over the exponential coordinates of a contact, xi = log(T_s_f) (SPEC part 2).

    Attributes:
        xi: (6,) mean [v, w], m and rad.
        sigma: (6,) standard deviation of each component, m and rad; the components are independent.
        in_range: the mean lies in the range of labels that the model was taught. Outside it, and out of contact, a
            prediction means little.
        markers: share of the markers expected in view that were seen, where the model looks for markers.
    """

    xi: Array
    sigma: Array
    in_range: bool
    markers: float | None = None


class ContactModel:
    """A trained model, ready to predict.

    Memory does not grow with the number of predictions. Not safe for use from two threads at once.
    """

    def __init__(self, model: Model) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(onnx_model(model), options, providers=["CPUExecutionProvider"])
        self.header: Header = model.header
        self.reference: ImageArray | None = model.reference
        self._preprocessing = model.header.preprocessing
        self._centre = model.header.labels.centre
        self._half_range = model.header.labels.half_range
        self._sigma_scale = np.array(model.header.sigma_scale) * self._half_range

    @classmethod
    def load(cls, path: Path) -> ContactModel:
        """Open a model file.

        Raises:
            ModelError: as ``model_file.load_model``.
        """
        return cls(load_model(path))

    def predict(self, image: ImageArray) -> Prediction:
        """Contact in one camera image.

        Raises:
            ImageError: the image is not what the model's preprocessing was made for.
        """
        return self.predict_reduced(self.reduce(image))

    def reduce(self, image: ImageArray) -> ImageArray:
        """The model's preprocessing, uint8 (height, width): what a contact gate compares. Raises as ``predict``."""
        return self._preprocessing.reduce(image)

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Contact in an image that ``reduce`` made, so that a gate and a prediction share the preprocessing."""
        return self._decode(self._run(scale(reduced)[None, None])[0])

    def predict_batch(self, images: Sequence[ImageArray]) -> list[Prediction]:
        """``predict`` of several images in one run; faster per image, and the whole batch is held in memory."""
        if not images:
            return []
        return [self._decode(row) for row in self._run(np.stack([self._preprocessing.apply(i) for i in images]))]

    def observe(self, sample: Stamped[Frame]) -> Stamped[Prediction]:
        """``predict`` of a camera's sample; the prediction keeps the stamp, number and quality of the frame."""
        return Stamped(
            self.predict(sample.value.image), sample.t_ns, sample.seq, sample.t_device_ns, quality=sample.quality
        )

    def _run(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        outputs: NDArray[np.float32] = self._session.run([OUTPUTS], {IMAGES: inputs})[0]
        return outputs

    def _decode(self, output: NDArray[np.float32]) -> Prediction:
        mean = output[:6].astype(np.float64)
        sigma = (
            self._sigma_scale * np.exp(-output[6:].astype(np.float64)) if len(output) > 6 else self._sigma_scale.copy()
        )
        return Prediction(
            xi=self._centre + self._half_range * mean,
            sigma=sigma,
            in_range=bool(np.all(np.abs(mean) <= 1.0 + RANGE_TOLERANCE)),
        )
