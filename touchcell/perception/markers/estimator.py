"""Contact pose and shear from the markers of one image at run time: NumPy and the compiled kernels only."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception import kernels
from touchcell.perception.errors import ModelError
from touchcell.perception.markers.camera_check import (
    CameraCheck,
    CameraFinding,
    TearCheck,
    fit_functionals,
    strength_rows,
)
from touchcell.perception.markers.detection import Discs, detect_markers
from touchcell.perception.markers.layers import layers_of, mixed
from touchcell.perception.markers.matching import DisplacementModel, FirstGuess, MarkerField, MarkerMatcher
from touchcell.perception.markers.transfer import TransferredNetworks
from touchcell.perception.models.marker_architecture import LOG_PRECISION_BOUNDS, MarkerArchitecture
from touchcell.perception.models.model_file import Header, Model, load_model
from touchcell.perception.models.prediction import Prediction

if TYPE_CHECKING:
    from touchcell.perception.models.camera_change import CameraChange


_NO_MARKERS = "the markers of the model's sensor were not found"
_NOISE_PX = 0.5


class MarkerEstimator:
    """A trained marker model, ready to predict.

    Matching is faster in consecutive images, as each starts from the previous one; the result is the same. Not safe for
    use from two threads at once.

    Attributes:
        header: of the model file.
        reference: preprocessed image out of contact, or None.
        field: the markers of the last image, None before the first.
        change: between this camera and the one the model was trained with, in pixels of the crop; None for none.
        camera: what the last image says of its camera; None where its markers were not matched.
    """

    def __init__(self, model: Model) -> None:
        """Create an estimator.

        Raises:
            TypeError: the model is of another kind.
        """
        architecture = model.header.architecture
        if not isinstance(architecture, MarkerArchitecture):
            raise TypeError(f"a model of kind {architecture.kind}, not markers")
        self.header: Header = model.header
        self.reference: ImageArray | None = model.reference
        self.field: MarkerField | None = None
        self.change: CameraChange | None = None
        self.camera: CameraFinding | None = None
        self._size = architecture.size
        self._matcher = matcher_of(model, architecture)
        self._camera_check = camera_check_of(model, self._matcher.model)
        self._networks = architecture.networks
        self._transferred: TransferredNetworks | None = None
        if model.header.transfer is not None:
            layers = [(weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers_of(model)]
            self._transferred = TransferredNetworks(model, layers, self._matcher.model.reference)
        # One long product is faster than several short ones with the same input.
        first, bias = model.tensors["layer0.weight"], model.tensors["layer0.bias"][:, 0]
        self._first = kernels.HalfLayers(
            np.ascontiguousarray(first.transpose(1, 0, 2)).reshape(1, first.shape[1], -1), bias.reshape(1, -1)
        )
        self._layers = [
            kernels.HalfLayers(model.tensors[f"layer{i}.weight"], model.tensors[f"layer{i}.bias"][:, 0])
            for i in range(1, len(architecture.hidden) + 1)
        ]

    @classmethod
    def load(cls, path: Path) -> MarkerEstimator:
        """Open a model file.

        Raises:
            ModelError: as ``model_file.load_model``, or the model is of another kind.
        """
        model = load_model(path)
        if model.header.architecture.kind != "markers":
            raise ModelError(path, f"is {model.header.architecture.kind}, expected markers", key="architecture.kind")
        return cls(model)

    def reduce(self, image: ImageArray) -> ImageArray:
        """Apply the model's preprocessing: uint8 (height, width), black and white, in the camera's resolution.

        Raises:
            ImageError: the image does not match the model's preprocessing.
        """
        return self.header.preprocessing.reduce(image)

    def predict(self, image: ImageArray) -> Prediction:
        """Estimate the contact in one camera image. Raises as ``reduce``."""
        return self.predict_reduced(self.reduce(image))

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Estimate the contact in an image returned by ``reduce``.

        Where the markers cannot be matched reliably, or the camera is another one, ``in_range`` is False and the sigmas
        are as wide as the training range. Where almost none can be matched, the prediction is the centre of that range.
        """
        field = self.match(self.find(reduced))
        return self.decode(field, *self.infer(field))

    def find(self, reduced: ImageArray) -> Discs:
        """First step of ``predict_reduced``: detect the discs, in the pixels of the model's own camera."""
        discs = detect_markers(reduced, self._size)
        return discs if self.change is None else Discs(self.change.points(discs.centres), discs.areas)

    def match(self, discs: Discs) -> MarkerField:
        """Second step: match the discs to markers."""
        self.field = self._matcher.match(discs, self.field)
        return self.field

    def infer(self, field: MarkerField) -> tuple[Array, Array]:
        """Third step: return mean (6,) in label half-ranges and standard deviations (6,) in label units of the mixture.

        Without any marker the result is the centre of the training range.
        """
        if not field.seen.any():
            return np.zeros(6), np.ones(6)
        if self._transferred is not None:
            means, sigmas = self._transferred(field.displacements.reshape(1, -1))
            return means[0], sigmas[0]
        x = self._first(field.displacements.reshape(1, -1).astype(np.float32)).reshape(self._networks, -1)
        for layer in self._layers:
            # Below -80 the exponential overflows, and the product is zero to float32 anyway.
            x = layer(np.asarray(x / (1.0 + np.exp(-np.maximum(x, np.float32(-80.0)))), np.float32))
        outputs = x.astype(np.float64)
        least, most = LOG_PRECISION_BOUNDS
        log_precision = np.minimum(np.maximum(outputs[:, 6:], least), most)
        return mixed(outputs[:, :6], log_precision, self.header.labels)

    def decode(self, field: MarkerField, mean: Array, sigma: Array) -> Prediction:
        """Last step: convert the result of ``infer`` to a Gaussian over xi."""
        labels = self.header.labels
        self.camera = self._camera_check(field.displacements.ravel(), field.seen) if field.valid else None
        refusal = _NO_MARKERS if self.camera is None else self.camera.refusal
        if not field.seen.any():
            return Prediction(*labels.xi_gaussian(mean, sigma), in_range=False, markers=0.0, refusal=refusal)
        calibrated = self.header.calibrated(sigma, mean)
        in_range = not refusal and labels.cover(mean, calibrated)
        # The networks' sigmas are valid only for markers that were matched, seen by the model's camera.
        xi, covariance = labels.xi_gaussian(mean, np.maximum(calibrated, 1.0) if refusal else calibrated)
        tail_scale = self.header.tail_scale
        return Prediction(
            xi,
            covariance,
            in_range,
            markers=field.score,
            refusal=refusal,
            tail_scale=tail_scale,
            displacements=field.displacements,
        )

    def observe(self, sample: Stamped[Frame]) -> Stamped[Prediction]:
        """Apply ``predict`` to a camera's sample; the prediction keeps the stamp, number and quality of the frame."""
        return Stamped(
            self.predict(sample.value.image), sample.t_ns, sample.seq, sample.t_device_ns, quality=sample.quality
        )


def displacement_model_of(model: Model) -> DisplacementModel:
    """Return the displacement model of a marker model."""
    reference, mean, basis, sd = (
        model.tensors[name].astype(np.float64)
        for name in ("lattice", "displacement.mean", "displacement.basis", "displacement.sd")
    )
    return DisplacementModel(reference, mean, basis, sd)


def camera_check_of(model: Model, displacement: DisplacementModel) -> CameraCheck:
    """Return the camera check of a marker model; for a file without one, that of its displacement model alone."""
    architecture = model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    spec = architecture.camera_check
    if spec is not None:
        mean = model.tensors["camera.mean"].astype(np.float64)
        tear = TearCheck(model.tensors["camera.basis"], mean, strength_rows(displacement), spec)
        return CameraCheck(model.tensors["camera.functionals"], mean, displacement.spacing_px, tear)
    mean = displacement.mean
    parts = [(displacement.basis, displacement.sd)]
    if model.header.transfer is not None:
        mean = model.tensors["transfer.mean"].astype(np.float64)
        basis = model.tensors["transfer.basis"].astype(np.float64)
        parts.append((basis, model.tensors["transfer.scores"].std(axis=0).astype(np.float64)))
    functionals = fit_functionals(displacement.reference, architecture.rings, mean, parts, _NOISE_PX)
    return CameraCheck(functionals, mean, displacement.spacing_px)


def matcher_of(model: Model, architecture: MarkerArchitecture) -> MarkerMatcher:
    """Return the matcher that a marker model describes."""
    return MarkerMatcher(
        displacement_model_of(model),
        FirstGuess(
            low=np.array(architecture.guess_low_px),
            cell_px=architecture.guess_cell_px,
            hidden_weight=np.ascontiguousarray(model.tensors["guess.hidden.weight"].T),
            hidden_bias=model.tensors["guess.hidden.bias"],
            weight=model.tensors["guess.output.weight"],
            bias=model.tensors["guess.output.bias"],
            sd=model.tensors["guess.sd"].astype(np.float64),
        ),
        architecture.input_size,
        bank=model.tensors["bank"].astype(np.float64),
        least_score=architecture.least_score,
        most_rms_px=architecture.most_rms_px,
    )
