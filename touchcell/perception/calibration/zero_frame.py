"""Zero-frame calibration: zoom, turn and shift of a camera from images of the tip out of contact, without labels.

A zoom by 1 % looks like 0.2 mm of depth. What is found is undone before the estimator.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import Discs, detect_markers, lattice, typical_size
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.marker_architecture import MarkerArchitecture
from touchcell.perception.models.model_file import Model
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.marker_learning import fit_lattice

_UPSCALED = 4
_WORST_RMS_PX = 3.0
_MOST_TURN_DEG = 25.0


def find_change(
    model: Model, frames: Sequence[ImageArray], *, taught: Sequence[ImageArray] = (), rings: int = 10
) -> CameraChange:
    """What has changed between the camera that taught a model and one that took images of the tip out of contact.

    Args:
        model: its image out of contact is what is compared with, or else its lattice, which lies over the least
            deformed contact that it was taught.
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
    aim = lattice(rings) if there is None else there
    turned = [points[order] for order in lattice_turns(rings)]
    return min(turned, key=lambda each: abs(np.angle(similarity(each, aim)[0])))


def _taught_lattice(model: Model, rings: int) -> Array:
    """(m, 2) px in the camera's image."""
    preprocessing = model.header.preprocessing
    corner = np.array(preprocessing.region[:2], dtype=np.float64)
    if model.reference is None:
        if "lattice" not in model.tensors:
            raise TrainingError(
                "the model holds no image out of contact to compare with",
                hint="give some of the sensor that it was trained on with --reference",
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
    """(m, 2) px in the camera's image."""
    image = preprocessing.in_full_resolution().model_copy(update={"mask_radius_px": None}).reduce(frame)
    corner = np.array(preprocessing.region[:2], dtype=np.float64)
    points: Array = _fitted(detect_markers(image, typical_size(image)), rings) + corner
    return points


def _fitted(discs: Discs, rings: int) -> Array:
    points, rms = fit_lattice(discs, rings)
    if not np.isfinite(rms):
        raise TrainingError(f"an image shows no lattice of {rings} rings", hint="is the tip out of contact?")
    return points
