"""Serve camera frames to a model that was trained on cropped, black and white images, as data sets are published."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from touchcell.perception.models.model_file import Model
from touchcell.perception.models.preprocessing import AdaptiveThreshold, Crop, Preprocessing

FRAME_SIZE: Final = (480, 640)
"""(height, width) px of a camera's frame."""

THRESHOLD: Final = AdaptiveThreshold(block_px=61, offset=-5.0)
MEDIAN_PX: Final = 5


def from_camera(
    preprocessing: Preprocessing, *, size: tuple[int, int] = FRAME_SIZE, corner: tuple[int, int] | None = None
) -> Preprocessing:
    """Return the preprocessing of grey camera frames for a model trained on cropped and thresholded images.

    The steps before the model's own are the paper's (Lloyd & Lepora 2024, 3.1.3): a crop, a 5x5 median and an adaptive
    threshold. A model that was trained on camera frames of this size, or on larger images, keeps its own preprocessing.

    Args:
        preprocessing: of the model.
        size: (height, width) px of the frames.
        corner: (left, top) px of the crop; None for the centre of the frame.
    """
    height, width = preprocessing.input_size
    if preprocessing.input_size == size or height > size[0] or width > size[1]:
        return preprocessing
    left, top = ((size[1] - width) // 2, (size[0] - height) // 2) if corner is None else corner
    own = preprocessing.region
    return preprocessing.model_copy(
        update={
            "input_size": size,
            "crop": Crop(left + own.left, top + own.top, left + own.right, top + own.bottom),
            "median_px": MEDIAN_PX,
            "threshold": THRESHOLD,
        }
    )


def served_from_camera(model: Model, *, corner: tuple[int, int] | None = None) -> Model:
    """Return the model with the preprocessing of ``from_camera``, and its change of camera in the frame."""
    header = model.header
    preprocessing = from_camera(header.preprocessing, corner=corner)
    camera = header.camera
    if camera is not None and preprocessing is not header.preprocessing:
        left, top = np.subtract(preprocessing.region[:2], header.preprocessing.region[:2]).tolist()
        u, v = camera.centre_px
        camera = camera.model_copy(update={"centre_px": (u + left, v + top)})
    return replace(model, header=header.model_copy(update={"preprocessing": preprocessing, "camera": camera}))
