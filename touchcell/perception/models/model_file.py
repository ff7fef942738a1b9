"""A trained model as one file, ``NAME.safetensors``: tensors, and all metadata needed to use them in the header."""

from __future__ import annotations

import json
import math
import os
import tempfile
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import ModelError
from touchcell.perception.models.architecture_spec import ArchitectureSection
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.labels import CONTACT_NAMES, contact_from_xi, shear_direction, xi_gaussian
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.models.transfer_spec import TransferSpec

_HOW_TO_TRAIN = "train one with `touchcell train --data DIR --out NAME.safetensors`"
_HOW_TO_ADAPT = (
    "adapt the model of the first sensor again, with the same labelled images: "
    "`touchcell adapt --model FIRST.safetensors --data DIR --out {out}`"
)
FORMAT_VERSION = 1
_METADATA_KEY = "touchcell"
_REFERENCE = "reference_image"

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Six = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
SixPositive = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
SixNotNegative = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]


_OUTSIDE = (0.05, 0.15)  # Label half-ranges by which any estimate, and the least certain one, may lie beyond the range.


class Labels(BaseModel):
    """Meaning of the outputs, and the training range.

    A network's mean o stands for ``centre + o * half_range``: contacts in mm and degrees (``of_contacts``), or
    exponential coordinates log(T_s_f) in m and rad. Slip blurs x, y and gamma. In the coordinates of a contact it stays
    there, in exponential coordinates it also blurs depth and tilt.

    The standard deviations that belong to a contact are those of its shear along and across the shear's own direction,
    then of z, alpha, beta and gamma, as slip errs along the shear (``xi_gaussian``).

    Attributes:
        names: of the six components.
        units: of the six components.
        low: smallest label of the training set.
        high: largest label of the training set.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    names: tuple[str, ...] = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
    units: tuple[str, ...] = ("m", "m", "m", "rad", "rad", "rad")
    low: Six
    high: Six

    @model_validator(mode="after")
    def _ordered(self) -> Labels:
        if any(high <= low for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("every high must exceed its low")
        return self

    @classmethod
    def of_contacts(cls, low: Six, high: Six) -> Labels:
        """Return labels for contacts between ``low`` and ``high``, mm and degrees, ordered as ``CONTACT_NAMES``."""
        return cls(names=CONTACT_NAMES, units=("mm", "mm", "mm", "deg", "deg", "deg"), low=low, high=high)

    @property
    def are_contacts(self) -> bool:
        """True if they are contacts rather than exponential coordinates."""
        return self.names == CONTACT_NAMES

    @cached_property
    def _ranges(self) -> tuple[Array, Array, Array]:
        """Centre, half range, and the half range with one for both directions of shear; read-only."""
        half = 0.5 * np.subtract(self.high, self.low, dtype=np.float64)
        shared = half.copy()
        shared[:2] = half[:2].mean()
        ranges = 0.5 * np.add(self.low, self.high, dtype=np.float64), half, shared
        for each in ranges:
            each.setflags(write=False)
        return ranges

    @property
    def centre(self) -> Array:
        """(6,) centre of the range."""
        return self._ranges[0]

    @property
    def half_range(self) -> Array:
        """(6,) half of the range."""
        return self._ranges[1]

    @property
    def sigma_unit(self) -> Array:
        """(6,) unit of the standard deviations: the half range, one for both directions of shear."""
        return self._ranges[2 if self.are_contacts else 1]

    def targets(self, xi: Array) -> Array:
        """Return (n, 6) training targets for contacts with exponential coordinates (n, 6), m and rad."""
        values = contact_from_xi(xi) if self.are_contacts else xi
        return np.divide(values - self.centre, self.half_range)

    def contacts(self, mean: Array) -> Array:
        """Return (..., 6) contacts, mm and degrees, of outputs (..., 6)."""
        values = self.centre + self.half_range * mean
        contacts: Array = values if self.are_contacts else contact_from_xi(values)
        return contacts

    def aligned(self, residual: Array, mean: Array) -> Array:
        """Return residuals (..., 6) of outputs about ``mean`` (..., 6), in the directions and units of the sigmas."""
        if not self.are_contacts:
            return residual
        along = shear_direction(self.centre + self.half_range * mean)
        values: Array = residual * self.half_range / self.sigma_unit
        x, y = values[..., 0].copy(), values[..., 1].copy()
        values[..., 0] = along[..., 0] * x + along[..., 1] * y
        values[..., 1] = along[..., 0] * y - along[..., 1] * x
        return values

    def cover(self, mean: Array, sigma: Array) -> bool:
        """Return True where outputs (6,) lie in the training range, or next to it.

        Estimates of contacts at its border scatter about them: outside by no more than one of the standard deviations
        (6,), and this no less than 0.05 and no more than 0.15 of the half range.
        """
        beyond = np.abs(mean) - 1.0
        if (beyond <= _OUTSIDE[0]).all():
            return True
        variance = np.square(sigma)
        if self.are_contacts:
            u, v = np.square(shear_direction(self.centre + self.half_range * mean))
            along, across = variance[:2]
            variance[:2] = u * along + v * across, v * along + u * across
        return bool((beyond <= np.clip(np.sqrt(variance), *_OUTSIDE)).all())

    def xi_gaussian(self, mean: Array, sigma: Array) -> tuple[Array, Array]:
        """Return means (..., 6) and covariances (..., 6, 6) of xi = log(T_s_f), m and rad, of outputs and sigmas."""
        values = self.centre + self.half_range * mean
        variance = (sigma * self.sigma_unit) ** 2
        covariance = variance[..., None] * np.eye(6)
        if not self.are_contacts:
            return values, covariance
        direction = shear_direction(values)
        u, v = direction[..., 0], direction[..., 1]
        along, across = variance[..., 0], variance[..., 1]
        covariance[..., 0, 0] = u**2 * along + v**2 * across
        covariance[..., 1, 1] = v**2 * along + u**2 * across
        covariance[..., 0, 1] = covariance[..., 1, 0] = u * v * (along - across)
        return xi_gaussian(values, covariance)


class SessionSpread(BaseModel):
    """What changes from one session of a sensor to the next: friction, and the zero of mount and camera.

    Where the shear exceeds ``free`` of the depth, skin slips, and what is left of shear and torsion depends on
    friction: the more, the further beyond. All are standard deviations of errors in addition to a network's own.

    Attributes:
        offset_mm_deg: (6,) of contacts; shear along and across its direction, then z, alpha, beta, gamma.
        slip: of the shear along its direction where all of it slips, relative to the shear.
        torsion_slip: of the torsion there, relative to the torsion.
        free: ratio of shear to depth up to which nothing slips.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    offset_mm_deg: SixNotNegative
    slip: NotNegative
    torsion_slip: NotNegative
    free: Positive

    def variance(self, contacts: Array | None) -> Array:
        """Return (..., 6) mm^2 and deg^2 at contacts (..., 6), mm and degrees; of the offsets alone without these."""
        if contacts is not None and contacts.ndim == 1:
            return self._variance_at(contacts)
        variance = np.empty((6,) if contacts is None else contacts.shape)
        variance[...] = self.offset_mm_deg
        variance *= variance
        if contacts is None:
            return variance
        shear = np.hypot(contacts[..., 0], contacts[..., 1])
        beyond = shear / (self.free * np.maximum(contacts[..., 2], 1e-3)) - 1.0
        slips = np.minimum(np.maximum(beyond, 0.0), 1.0)
        variance[..., 0] += (self.slip * slips * shear) ** 2
        variance[..., 5] += (self.torsion_slip * slips * contacts[..., 5]) ** 2
        return variance

    def _variance_at(self, contact: Array) -> Array:
        """Return the (6,) of one contact (6,), as in every frame: numbers take a fifth of the time of arrays."""
        x, y, depth, _, _, torsion = contact.tolist()
        shear = math.hypot(x, y)
        slips = min(max(shear / (self.free * max(depth, 1e-3)) - 1.0, 0.0), 1.0)
        u, v, z, alpha, beta, gamma = self.offset_mm_deg
        along = u * u + (self.slip * slips * shear) ** 2
        about = gamma * gamma + (self.torsion_slip * slips * torsion) ** 2
        return np.array([along, v * v, z * z, alpha * alpha, beta * beta, about])


class Header(BaseModel):
    """Metadata of a model.

    Attributes:
        format_version: of this header.
        touchcell_version: version that wrote it.
        architecture: the tensors and their graph.
        preprocessing: from camera image to network input.
        labels: meaning of the outputs.
        sigma_scale: (6,) calibration factor of a network's standard deviations raised to ``sigma_power``; cnn: the
            standard deviations themselves. In ``labels.sigma_unit``, along ``labels.aligned``. Found on the validation
            split.
        sigma_power: (6,) see ``sigma_scaling.calibrate``.
        session: what is added for other sessions than the validation set's; None adds nothing.
        tail_scale: factor of the covariance that makes it the scale of a Student-t with four degrees of freedom, whose
            tails are those of the errors; None for a Gaussian.
        camera: from the pixels of this model's sensor to those of the one its networks were trained on, where it was
            adapted (``touchcell adapt``).
        label_turn_deg: rotation of its contacts' axes about the sensor's z axis, to those of the networks' training.
        transfer: from the networks' outputs to this sensor's contacts, where it was adapted so.
        network_labels: labels of the networks' training, where ``labels`` are those of the transfer.
        training_data: digest of the training set (``LabelledImages.digest``).
        training: settings and results of the training, for information.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    format_version: Literal[1] = 1
    touchcell_version: str
    architecture: ArchitectureSection
    preprocessing: Preprocessing
    labels: Labels
    sigma_scale: SixPositive
    sigma_power: SixPositive = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    session: SessionSpread | None = None
    tail_scale: Positive | None = None
    camera: CameraChange | None = None
    label_turn_deg: Finite = 0.0
    transfer: TransferSpec | None = None
    network_labels: Labels | None = None
    training_data: str
    training: dict[str, str | int | float | list[float] | None] = {}

    def calibrated(self, sigma: Array, mean: Array | None = None) -> Array:
        """Return (..., 6) calibrated standard deviations of the network's (..., 6).

        Args:
            sigma: in ``labels.sigma_unit``.
            mean: (..., 6) that belongs to it, in label half-ranges; None leaves out what slip adds in other sessions.
        """
        calibrated: Array = np.array(self.sigma_scale) * sigma ** np.array(self.sigma_power)
        if self.session is None or not self.labels.are_contacts:
            return calibrated
        more = self.session.variance(None if mean is None else self.labels.contacts(mean))
        return np.sqrt(calibrated**2 + more / self.labels.sigma_unit**2)

    @model_validator(mode="after")
    def _preprocessing_feeds_network(self) -> Header:
        if self.preprocessing.output_size != self.architecture.input_size:
            raise ValueError("the preprocessing's output_size is not the architecture's input_size")
        if (self.transfer is None) != (self.network_labels is None):
            raise ValueError("transfer and network_labels belong together")
        if self.transfer is not None and self.architecture.kind != "markers":
            raise ValueError("only a marker model can be transferred")
        return self


@dataclass(frozen=True)
class Model:
    """A trained network.

    Attributes:
        header: its metadata.
        tensors: float32, as ``header.architecture.tensor_shapes`` names them.
        reference: the preprocessed image (height, width) of the sensor out of contact, or None when there is none.
    """

    header: Header
    tensors: dict[str, NDArray[np.float32]]
    reference: ImageArray | None = None


def touchcell_version() -> str:
    """Return the version of the installed touchcell."""
    return version("touchcell")


def save_model(model: Model, path: Path) -> None:
    """Write a model file atomically.

    Raises:
        ModelError: a tensor is missing, of the wrong shape or not finite.
    """
    from safetensors.numpy import save

    _check_tensors(model, path)
    tensors: dict[str, NDArray[np.generic]] = dict(model.tensors)
    if model.reference is not None:
        tensors[_REFERENCE] = model.reference
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        unfinished = Path(scratch) / path.name
        unfinished.write_bytes(save(tensors, metadata={_METADATA_KEY: model.header.model_dump_json()}))
        os.replace(unfinished, path)


def load_model(path: Path) -> Model:
    """Read a model file.

    Raises:
        ModelError: the file is missing, truncated, not a touchcell model, of a newer format, or its tensors do not
            match
            its header.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise ModelError(path, "no such file", hint=_HOW_TO_TRAIN)
    try:
        with safe_open(path, framework="np") as stored:
            metadata = stored.metadata() or {}
            header = _parse_header(metadata.get(_METADATA_KEY), path)
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(path, f"damaged, or not a safetensors file: {error}", hint="copy or train it again") from error
    model = Model(header, tensors, reference=tensors.pop(_REFERENCE, None))
    _check_tensors(model, path)
    return model


def load_header(path: Path) -> Header:
    """Read the header of a model file, and none of its tensors.

    Raises:
        ModelError: the file is missing, not a touchcell model, or of a newer format.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise ModelError(path, "no such file", hint=_HOW_TO_TRAIN)
    try:
        with safe_open(path, framework="np") as stored:
            return _parse_header((stored.metadata() or {}).get(_METADATA_KEY), path)
    except (SafetensorError, OSError) as error:
        raise ModelError(path, f"damaged or no safetensors file: {error}", hint="copy or train it again") from error


def _parse_header(text: str | None, path: Path) -> Header:
    if text is None:
        raise ModelError(path, "a safetensors file, but not a touchcell model", key=_METADATA_KEY)
    try:
        fields = json.loads(text)
    except json.JSONDecodeError as error:
        raise ModelError(path, f"header is not JSON: {error}", key=_METADATA_KEY) from error
    found = fields.get("format_version") if isinstance(fields, dict) else None
    if found != FORMAT_VERSION:
        newer = isinstance(found, int) and found > FORMAT_VERSION
        raise ModelError(
            path,
            f"format {found}, this touchcell reads {FORMAT_VERSION}",
            key="format_version",
            hint="install a newer touchcell" if newer else "train it again",
        )
    try:
        return Header.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        key = _key(first["type"], first["loc"])
        if first["loc"][:1] == ("transfer",):
            reason = "adapted to its sensor by another version of touchcell, whose processes have other inputs"
            hint = _HOW_TO_ADAPT.format(out=path.name)
            raise ModelError(path, f"{reason} ({first['msg']})", key=key, hint=hint) from error
        raise ModelError(path, first["msg"], key=key, hint="train it again") from error


def _key(error: str, location: tuple[int | str, ...]) -> str:
    """Return the header field that an error of pydantic refers to; an unknown architecture is one of its kind."""
    return ".".join([*map(str, location), *(["kind"] if error.startswith("plugin") else [])])


def _check_tensors(model: Model, path: Path) -> None:
    architecture, transfer = model.header.architecture, model.header.transfer
    shapes = architecture.tensor_shapes()
    if transfer is not None:
        shapes |= transfer.tensor_shapes()
    for name in shapes.keys() | model.tensors.keys():
        if name not in model.tensors:
            raise ModelError(path, "missing tensor", key=name)
        if name not in shapes:
            raise ModelError(path, "tensor that the architecture does not have", key=name)
        tensor = model.tensors[name]
        if tensor.shape != shapes[name] or tensor.dtype != np.float32:
            raise ModelError(path, f"{tensor.dtype} {tensor.shape}, expected float32 {shapes[name]}", key=name)
        if not np.isfinite(tensor).all():
            raise ModelError(path, "holds values that are not finite", key=name)
    reference = model.reference
    if reference is not None and (
        reference.dtype != np.uint8 or reference.shape != model.header.preprocessing.output_size
    ):
        raise ModelError(path, "is not an image of the preprocessing's output size", key=_REFERENCE)
