"""Zero-frame calibration: zoom, rotation and shift of a camera from unlabelled images of the tip out of contact.

A zoom by 1 % resembles 0.2 mm of depth. The change found is undone before the estimator.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import Discs, detect_markers, lattice, typical_size
from touchcell.perception.markers.lattice_fit import fit_lattice
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.marker_architecture import MarkerArchitecture
from touchcell.perception.models.model_file import Model
from touchcell.perception.models.preprocessing import Preprocessing

_UPSCALED = 4
_WORST_RMS_PX = 3.0
_MOST_TURN_DEG = 25.0


def find_change(
    model: Model, frames: Sequence[ImageArray], *, taught: Sequence[ImageArray] = (), rings: int = 10
) -> CameraChange:
    """Find the change between the camera a model was trained with and one that took images of the tip out of contact.

    Args:
        model: its image out of contact is the reference, or else its lattice, from the least deformed contact of its
            training set.
        frames: camera images out of contact; their median result counts.
        taught: such images of the sensor that the model was trained on, in place of what the model holds.
        rings: of the lattice, where the model does not define it.

    Raises:
        TrainingError: no lattice is found, or the model holds no reference, or the images differ by more than a
            similarity.
        ImageError: the images are not of the model's input size.
    """
    preprocessing = model.header.preprocessing
    architecture = model.header.architecture
    if isinstance(architecture, MarkerArchitecture):
        rings = architecture.rings
    if taught:
        reference = np.median(
            [_nearest_turn(_lattice(each, preprocessing, rings), rings, None) for each in taught], axis=0
        )
    else:
        reference = _taught_lattice(model, rings)
    found = []
    for frame in frames:
        observed = _nearest_turn(_lattice(frame, preprocessing, rings), rings, reference)
        linear, off = similarity(observed, reference)
        centre = observed.mean(axis=0)
        to = reference.mean(axis=0) - centre
        found.append([abs(linear), np.degrees(np.angle(linear)), *centre, *to, off])
    if not found:
        raise TrainingError("no image to calibrate with", hint="take ten or more of the tip out of contact")
    zoom, turn, u, v, du, dv, rms = np.median(found, axis=0)
    if rms > _WORST_RMS_PX or abs(turn) > _MOST_TURN_DEG:
        raise TrainingError(
            f"the undeformed markers are {rms:.1f} px off after a rotation by {turn:.1f} deg",
            hint="the tip touches something, or is another one: for that use `touchcell adapt` with labelled images",
        )
    return CameraChange(zoom=zoom, turn_deg=turn, centre_px=(u, v), shift_px=(du, dv), frames=len(found), rms_px=rms)


def similarity(source: Array, target: Array) -> tuple[complex, float]:
    """Return scale and rotation, as one complex number, that map ``source`` onto ``target``, and the rms residual, px.

    Args:
        source, target: (m, 2) px; their means are subtracted.
    """
    a = (source - source.mean(axis=0)) @ np.array([1.0, 1j])
    b = (target - target.mean(axis=0)) @ np.array([1.0, 1j])
    linear = complex(np.vdot(a, b) / np.vdot(a, a))
    return linear, float(np.sqrt((np.abs(linear * a - b) ** 2).mean()))


def lattice_turns(rings: int) -> list[NDArray[np.intp]]:
    """Return six orders (m,) of a lattice's markers, one for each rotation by a multiple of 60 degrees."""
    first = np.concatenate([[0], 1 + 3 * np.arange(rings) * np.arange(1, rings + 1)])
    turns = []
    for sixth in range(6):
        order = [np.zeros(1, np.intp)]
        order += [first[ring] + (np.arange(6 * ring) + sixth * ring) % (6 * ring) for ring in range(1, rings + 1)]
        turns.append(np.concatenate(order))
    return turns


def _nearest_turn(points: Array, rings: int, reference: Array | None) -> Array:
    """Return a lattice's points in the order of smallest rotation from ``reference``, or from the image's u axis."""
    aim = lattice(rings) if reference is None else reference
    turned = [points[order] for order in lattice_turns(rings)]
    return min(turned, key=lambda each: abs(np.angle(similarity(each, aim)[0])))


def _taught_lattice(model: Model, rings: int) -> Array:
    """Return the lattice of the model's training images, (m, 2) px in the camera's image."""
    preprocessing = model.header.preprocessing
    corner = np.array(preprocessing.region[:2], dtype=np.float64)
    if model.reference is None:
        if "lattice" not in model.tensors:
            raise TrainingError(
                "the model contains no image out of contact to compare with",
                hint="pass images of the sensor that it was trained on with --reference",
            )
        taught: Array = model.tensors["lattice"].astype(np.float64) + corner
        if model.header.camera is not None:
            matrix = model.header.camera.matrix
            taught = (taught - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
        return taught
    height, width = model.reference.shape
    large = cv2.resize(model.reference, (_UPSCALED * width, _UPSCALED * height), interpolation=cv2.INTER_CUBIC)
    image = np.where(large > 127, np.uint8(255), np.uint8(0))
    points = _fitted(detect_markers(image, typical_size(image)), rings)
    rows, columns = preprocessing.in_full_resolution().output_size
    scale = np.array([columns / (_UPSCALED * width), rows / (_UPSCALED * height)])
    placed: Array = (points + 0.5) * scale - 0.5 + corner
    return placed


def _lattice(frame: ImageArray, preprocessing: Preprocessing, rings: int) -> Array:
    """Return the lattice of one frame, (m, 2) px in the camera's image."""
    image = preprocessing.in_full_resolution().model_copy(update={"mask_radius_px": None}).reduce(frame)
    corner = np.array(preprocessing.region[:2], dtype=np.float64)
    points: Array = _fitted(detect_markers(image, typical_size(image)), rings) + corner
    return points


def _fitted(discs: Discs, rings: int) -> Array:
    points, rms = fit_lattice(discs, rings)
    if not np.isfinite(rms):
        raise TrainingError(f"no lattice of {rings} rings found in an image", hint="is the tip out of contact?")
    return points
