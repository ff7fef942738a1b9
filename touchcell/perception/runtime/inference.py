"""Contact pose and shear from one image at run time: ONNX Runtime on one thread, no PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry.types import ImageArray
from touchcell.perception import kernels
from touchcell.perception.markers.image_check import ImageCheck
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.graph import IMAGES, OUTPUTS, onnx_model
from touchcell.perception.models.model_file import Header, Model, load_model
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.models.preprocessing import scale
from touchcell.perception.runtime.marker_texture import MarkerTexture

Runner = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Network evaluation: float32 (n, 1, height, width) in [0, 1] to its outputs (n, outputs)."""


def onnx_runtime(model: Model) -> Runner:
    """Load a model's network in ONNX Runtime, on the calling thread only."""
    return _session(onnx_model(model))


def _session(graph: bytes) -> Runner:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # For batches of one neither of these is faster: a memory plan per input shape (1 MB), and a second, packed copy of
    # the weights (3 MB).
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.disable_prepacking", "1")
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    # The session keeps the serialised model for a fallback provider: 2 to 6 MB, and there is no other provider.
    if hasattr(session, "_model_bytes"):
        session._model_bytes = None

    def run(inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        outputs: NDArray[np.float32] = session.run([OUTPUTS], {IMAGES: inputs})[0]
        return outputs

    return run


_MENDED, _SETTLED = 3, 0.04
_OTHER = "the image does not show the model's sensor as its camera would"


class ContactModel:
    """A trained image network, ready to predict.

    Memory does not grow with the number of predictions. Not safe for use from two threads at once.

    Args:
        model: the trained model.
        runner: evaluates its network; None for ``onnx_runtime``.

    Raises:
        TypeError: the model is no image network.
    """

    def __init__(self, model: Model, runner: Runner | None = None) -> None:
        architecture = model.header.architecture
        if not isinstance(architecture, Architecture):
            raise TypeError(f"{architecture.kind} is no image network")
        self._first: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if runner is None and kernels.compiled():
            weight, bias = model.tensors["conv0.weight"], model.tensors["conv0.bias"]
            self._first = np.ascontiguousarray(weight.reshape(len(bias), 9) / np.float32(255.0)), bias
            runner = _session(onnx_model(model, after_first_block=True))
        self._run = runner or onnx_runtime(model)
        self.header: Header = model.header
        self.reference: ImageArray | None = model.reference
        self._preprocessing = model.header.preprocessing
        spec = architecture.check
        self._check = None if spec is None else ImageCheck(spec, model.tensors, model.header.preprocessing)
        texture = None if spec is not None or model.reference is None else MarkerTexture(model.reference)
        self._texture = texture if texture is not None and texture.usable else None

    @classmethod
    def load(cls, path: Path) -> ContactModel:
        """Open a model file.

        Raises:
            ModelError: as ``model_file.load_model``.
        """
        return cls(load_model(path))

    def predict(self, image: ImageArray) -> Prediction:
        """Estimate the contact in one camera image.

        Raises:
            ImageError: the image does not match the model's preprocessing.
        """
        return self.predict_reduced(self.reduce(image))

    def reduce(self, image: ImageArray) -> ImageArray:
        """Apply the model's preprocessing: uint8 (height, width), input of a contact gate. Raises as ``predict``."""
        return self._preprocessing.reduce(image)

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Estimate the contact in an image returned by ``reduce``.

        A gate and a prediction can share the preprocessing. An image that is not of the model's own sensor and camera,
        as far as its file shows, is not ``in_range``, whatever the network's output.
        """
        return self._judged(self.infer(reduced), reduced)

    def _judged(self, outputs: NDArray[np.float32], reduced: ImageArray) -> Prediction:
        refusal = ""
        if self._check is not None:
            found = self._check.find(reduced, outputs[:6])
            for _ in range(_MENDED):
                mended = self._check.mended(reduced, found)
                if mended is None:
                    break
                before, outputs = outputs, self.infer(mended)
                found = self._check.find(reduced, outputs[:6], found)
                if np.abs(outputs - before)[:6].max() < _SETTLED:
                    break
            refusal = self._check.refusal(found)
        elif self._texture is not None and not self._texture.plausible(reduced):
            refusal = _OTHER
        prediction = self.decode(outputs)
        return replace(prediction, in_range=False, refusal=refusal) if refusal else prediction

    def infer(self, reduced: ImageArray) -> NDArray[np.float32]:
        """First step of ``predict_reduced``: return the network's outputs."""
        outputs: NDArray[np.float32] = self._run(self._input(reduced)[None])[0]
        return outputs

    def _input(self, reduced: ImageArray) -> NDArray[np.float32]:
        return scale(reduced)[None] if self._first is None else kernels.first_block(reduced, *self._first)

    def predict_batch(self, images: Sequence[ImageArray]) -> list[Prediction]:
        """Apply ``predict`` to several images in one run; faster per image, and the whole batch is held in memory."""
        if not images:
            return []
        reduced = [self.reduce(image) for image in images]
        rows = self._run(np.stack([self._input(each) for each in reduced]))
        return [self._judged(row, each) for row, each in zip(rows, reduced, strict=True)]

    def observe(self, sample: Stamped[Frame]) -> Stamped[Prediction]:
        """Apply ``predict`` to a camera's sample; the prediction keeps the stamp, number and quality of the frame."""
        return Stamped(
            self.predict(sample.value.image), sample.t_ns, sample.seq, sample.t_device_ns, quality=sample.quality
        )

    def decode(self, output: NDArray[np.float32]) -> Prediction:
        """Last step of ``predict_reduced``: convert the network's outputs to a Gaussian over xi."""
        mean = output[:6].astype(np.float64)
        sigma = np.exp(-output[6:].astype(np.float64)) if len(output) > 6 else np.ones(6)
        calibrated = self.header.calibrated(sigma, mean)
        labels = self.header.labels
        covered = labels.cover(mean, calibrated)
        return Prediction(*labels.xi_gaussian(mean, calibrated), covered, tail_scale=self.header.tail_scale)
