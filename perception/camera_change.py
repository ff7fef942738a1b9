"""Zero-frame calibration: how another camera sees the undeformed markers, beside the one that a model was taught with.

A zoom by 1 % looks like 0.2 mm of depth. It, a shift and a turn can be read off a few images of the tip out of contact,
without labels, and undone before the estimator.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.errors import ConfigError
from geometry.types import Array, ImageArray
from perception.errors import TrainingError
from perception.estimators import ContactEstimator
from perception.inference import Prediction
from perception.marker_architecture import MarkerArchitecture
from perception.marker_learning import fit_lattice
from perception.markers import Discs, detect_markers, typical_size
from perception.model_file import Header, Model
from perception.preprocessing import Preprocessing

_UPSCALED = 4
_WORST_RMS_PX = 3.0
_MOST_TURN_DEG = 25.0

Number = Annotated[float, Field(allow_inf_nan=False)]


class CameraChange(BaseModel):
    """A similarity from this sensor's image pixels to those of the sensor that taught the model.

    Attributes:
        zoom: by which the taught camera sees the markers larger.
        turn_deg: of the image about ``centre_px``, from u to v.
        centre_px: middle of the undeformed markers here.
        shift_px: from there to where the taught camera has it.
        frames: images that it was found in.
        rms_px: of the undeformed markers from the taught ones, after the change.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Literal[1] = Field(default=1, alias="schema")
    zoom: float = Field(gt=0.2, lt=5.0, allow_inf_nan=False)
    turn_deg: Number
    centre_px: tuple[Number, Number]
    shift_px: tuple[Number, Number]
    frames: int = Field(default=0, ge=0)
    rms_px: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)

    @property
    def matrix(self) -> Array:
        """(2, 3) from homogeneous pixels here to pixels there."""
        turn = np.deg2rad(self.turn_deg)
        linear = self.zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        centre = np.array(self.centre_px)
        return np.column_stack([linear, centre + np.array(self.shift_px) - linear @ centre])

    def points(self, pixels: Array) -> Array:
        """(..., 2) px there, of pixels (..., 2) here."""
        matrix = self.matrix
        moved: Array = pixels @ matrix[:, :2].T + matrix[:, 2]
        return moved

    def image(self, image: ImageArray) -> ImageArray:
        """An image as the taught camera would have taken it; what lies outside is black, and grey levels stay two."""
        height, width = image.shape[:2]
        warped = np.asarray(cv2.warpAffine(image, self.matrix, (width, height), flags=cv2.INTER_CUBIC), dtype=np.uint8)
        if ((image == 0) | (image == 255)).all():
            return np.where(warped > 127, np.uint8(255), np.uint8(0))
        return warped

    def undone(self, image: ImageArray) -> ImageArray:
        """An image of the taught camera as this one would have taken it."""
        height, width = image.shape[:2]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, self.matrix, (width, height), flags=flags), dtype=np.uint8)

    def save(self, path: Path) -> None:
        """Write a calibration file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(self.model_dump(mode="json", by_alias=True), sort_keys=False), encoding="utf-8")


def load_change(path: Path) -> CameraChange:
    """Read a calibration file.

    Raises:
        ConfigError: there is none, or it makes no sense.
    """
    try:
        return CameraChange.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except OSError as error:
        hint = "make one with `touchcell calibrate`"
        raise ConfigError(f"cannot be read: {error.strerror}", file=str(path), hint=hint) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"is no YAML: {error}", file=str(path)) from None
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(first["msg"], file=str(path), key=".".join(map(str, first["loc"]))) from None


class CalibratedEstimator:
    """An estimator whose camera images are brought to what its own sensor would have seen.

    A marker estimator gets its discs moved, at no cost to their accuracy; any other its images warped.
    """

    def __init__(self, estimator: ContactEstimator, change: CameraChange) -> None:
        from perception.marker_estimator import MarkerEstimator

        self._estimator = estimator
        self._warps = not isinstance(estimator, MarkerEstimator)
        self._change = change if self._warps else in_crop(change, estimator.header.preprocessing)
        if isinstance(estimator, MarkerEstimator):
            estimator.change = self._change

    @property
    def header(self) -> Header:
        """Of the model file."""
        return self._estimator.header

    @property
    def reference(self) -> ImageArray | None:
        """The model's image out of contact, as ``reduce`` makes one of this sensor."""
        reference = self._estimator.reference
        return reference if reference is None or self._warps else self._change.undone(reference)

    def reduce(self, image: ImageArray) -> ImageArray:
        """The model's preprocessing, of the image as the model's own camera would have taken it. Raises ImageError."""
        return self._estimator.reduce(self._change.image(image) if self._warps else image)

    def predict(self, image: ImageArray) -> Prediction:
        """Contact in one camera image. Raises ImageError."""
        return self.predict_reduced(self.reduce(image))

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        """Contact in an image that ``reduce`` made."""
        return self._estimator.predict_reduced(reduced)


def in_crop(change: CameraChange, preprocessing: Preprocessing) -> CameraChange:
    """The same change in the pixels of the crop."""
    if preprocessing.crop is None:
        return change
    u, v = change.centre_px
    return change.model_copy(update={"centre_px": (u - preprocessing.crop.left, v - preprocessing.crop.top)})


def find_change(
    model: Model, frames: Sequence[ImageArray], *, taught: Sequence[ImageArray] = (), rings: int = 10
) -> CameraChange:
    """What has changed between the camera that taught a model and one that took images of the tip out of contact.

    Args:
        model: its lattice, or its image out of contact, is what is compared with.
        frames: camera images out of contact; the medians over them count.
        taught: such images of the sensor that taught the model, in place of what the model holds.
        rings: of the lattice, where the model does not say.

    Raises:
        TrainingError: no lattice is found, or the model holds nothing to compare with, or the images differ by more
            than a similarity.
        ImageError: the images are not of the size that the model takes.
    """
    preprocessing = model.header.preprocessing
    architecture = model.header.architecture
    if isinstance(architecture, MarkerArchitecture):
        rings = architecture.rings
    if taught:
        there = np.median([_nearest_turn(_lattice(each, preprocessing, rings), rings, None) for each in taught], axis=0)
    else:
        there = _taught_lattice(model, rings)
    found = []
    for frame in frames:
        here = _nearest_turn(_lattice(frame, preprocessing, rings), rings, there)
        linear, off = similarity(here, there)
        centre = here.mean(axis=0)
        to = there.mean(axis=0) - centre
        found.append([abs(linear), np.degrees(np.angle(linear)), *centre, *to, off])
    if not found:
        raise TrainingError("no image to calibrate with", hint="take ten or more of the tip out of contact")
    zoom, turn, u, v, du, dv, rms = np.median(found, axis=0)
    if rms > _WORST_RMS_PX or abs(turn) > _MOST_TURN_DEG:
        raise TrainingError(
            f"the undeformed markers are {rms:.1f} px off after a turn by {turn:.1f} deg",
            hint="this is another tip, or it touches something; `touchcell adapt` takes labelled images",
        )
    return CameraChange(zoom=zoom, turn_deg=turn, centre_px=(u, v), shift_px=(du, dv), frames=len(found), rms_px=rms)


def similarity(here: Array, there: Array) -> tuple[complex, float]:
    """The zoom and turn, as one complex number, that bring points onto points, and the rms px that is left.

    Args:
        here, there: (m, 2) px; shifts are left aside.
    """
    a = (here - here.mean(axis=0)) @ np.array([1.0, 1j])
    b = (there - there.mean(axis=0)) @ np.array([1.0, 1j])
    linear = complex(np.vdot(a, b) / np.vdot(a, a))
    return linear, float(np.sqrt((np.abs(linear * a - b) ** 2).mean()))


def lattice_turns(rings: int) -> list[NDArray[np.intp]]:
    """Six orders (m,) of a lattice's markers, each turned by a sixth of a round."""
    first = np.concatenate([[0], 1 + 3 * np.arange(rings) * np.arange(1, rings + 1)])
    turns = []
    for sixth in range(6):
        order = [np.zeros(1, np.intp)]
        order += [first[ring] + (np.arange(6 * ring) + sixth * ring) % (6 * ring) for ring in range(1, rings + 1)]
        turns.append(np.concatenate(order))
    return turns


def _nearest_turn(points: Array, rings: int, there: Array | None) -> Array:
    """A lattice's points in the order that needs the smallest turn onto ``there``, or onto the image's u axis."""
    from perception.markers import lattice

    aim = lattice(rings) if there is None else there
    turned = [points[order] for order in lattice_turns(rings)]
    return min(turned, key=lambda each: abs(np.angle(similarity(each, aim)[0])))


def _taught_lattice(model: Model, rings: int) -> Array:
    """(m, 2) px in the camera's image."""
    preprocessing = model.header.preprocessing
    corner = np.array(preprocessing.crop[:2] if preprocessing.crop else (0, 0), dtype=np.float64)
    if "lattice" in model.tensors:
        lattice: Array = model.tensors["lattice"].astype(np.float64) + corner
        return lattice
    if model.reference is None:
        raise TrainingError(
            "the model holds no image out of contact to compare with",
            hint="give some of the sensor that it was trained on with --reference",
        )
    height, width = model.reference.shape
    large = cv2.resize(model.reference, (_UPSCALED * width, _UPSCALED * height), interpolation=cv2.INTER_CUBIC)
    image = np.where(large > 127, np.uint8(255), np.uint8(0))
    points = _fitted(detect_markers(image, typical_size(image)), rings)
    rows, columns = _crop_size(preprocessing)
    scale = np.array([columns / (_UPSCALED * width), rows / (_UPSCALED * height)])
    placed: Array = (points + 0.5) * scale - 0.5 + corner
    return placed


def _lattice(frame: ImageArray, preprocessing: Preprocessing, rings: int) -> Array:
    """(m, 2) px in the camera's image."""
    whole = preprocessing.model_copy(update={"output_size": _crop_size(preprocessing), "mask_radius_px": None})
    image = whole.reduce(frame)
    corner = preprocessing.crop[:2] if preprocessing.crop else (0, 0)
    points: Array = _fitted(detect_markers(image, typical_size(image)), rings) + np.array(corner, dtype=np.float64)
    return points


def _fitted(discs: Discs, rings: int) -> Array:
    points, rms = fit_lattice(discs, rings)
    if not np.isfinite(rms):
        raise TrainingError(f"an image shows no lattice of {rings} rings", hint="is the tip out of contact?")
    return points


def _crop_size(preprocessing: Preprocessing) -> tuple[int, int]:
    crop = preprocessing.crop
    return preprocessing.input_size if crop is None else (crop.bottom - crop.top, crop.right - crop.left)
