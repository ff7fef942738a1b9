"""``touchcell train-sim``: the estimator for the simulated sensor, from simulated camera frames alone.

Frames are drawn as the simulated camera draws them and go through the model's own preprocessing, so that training and
serving cannot differ. The sensors scatter a little about the default one, so that the model learns the kind and not
one of them by heart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.simulation.render import FRAME_SIZE, PUBLIC_CROP, FrameRenderer
from drivers.simulation.samples import Variation, contacts
from drivers.simulation.tip import Tip
from geometry import se3
from geometry.types import ImageArray
from perception.architecture import Architecture
from perception.dataset import LabelledImages
from perception.preprocessing import AdaptiveThreshold, Crop, Preprocessing
from perception.training import Settings, train_on_arrays
from perception.training_display import Display, Observer

PREPROCESSING = Preprocessing(
    input_size=(FRAME_SIZE[1], FRAME_SIZE[0]),
    crop=Crop(*PUBLIC_CROP),
    median_px=5,
    threshold=AdaptiveThreshold(block_px=61, offset=-5.0),
)
"""The paper's chain (3.1.3) with the crop of the public data."""

# Weights below 3 MB, so that the file can ship.
ARCHITECTURE = Architecture(channels=(8, 16, 32, 64, 128), hidden=192)

# From the first touch to beyond the depth at which objects are tracked, so that neither is outside the training range.
DEPTH_MM = (0.0, 6.5)

VARIATION = Variation(parameters=0.01, turn_rad=0.002, shift_px=0.3, marker_px=0.1, disc_radius=0.03, missing=0.002)


def train_on_simulation(out: Path, *, samples: int, epochs: int | None = None, seed: int = 0) -> None:
    """Draw ``samples`` training images and a fifth of that for validation, train, and write the model file.

    Raises:
        TrainingError: as ``perception.training.train``.
    """
    with Display() as display:
        training = draw(samples, seed, "train", display)
        validation = draw(samples // 5, seed + 1_000_000, "val", display)
        train_on_arrays(
            training,
            validation,
            out,
            preprocessing=PREPROCESSING,
            architecture=ARCHITECTURE,
            settings=Settings(seed=seed, batch_size=32) if epochs is None else Settings(epochs, seed, batch_size=32),
            reference=_out_of_contact(seed),
            observer=display,
        )


def draw(samples: int, seed: int, split: str, observer: Observer) -> LabelledImages:
    """Preprocessed simulated frames with their labels, the same for the same seed."""
    height, width = PREPROCESSING.output_size
    images: ImageArray = np.empty((samples, height, width), np.uint8)
    labels = np.empty((samples, 4, 4))
    renderers: dict[float, FrameRenderer] = {}
    for i, contact in enumerate(contacts(samples, seed, depth_mm=DEPTH_MM, variation=VARIATION)):
        # A renderer draws discs of one radius; a twentieth of a pixel is finer than anybody sees.
        radius_px = round(20 * contact.disc_radius_px) / 20
        if radius_px not in renderers:
            renderers[radius_px] = FrameRenderer(radius_px, seed=seed)
        images[i] = PREPROCESSING.reduce(renderers[radius_px].raw(contact.pixels, i))
        labels[i] = contact.T_f_s
        if i % 100 == 0:
            observer.images(split, i, samples)
    observer.images(split, samples, samples)
    return LabelledImages(images, se3.log(se3.inverse(labels)))


def _out_of_contact(seed: int) -> ImageArray:
    """What the default sensor sees when it touches nothing."""
    tip = Tip()
    frame = FrameRenderer(tip.parameters.disc_radius_px, seed=seed).raw(tip.project(tip.rest_positions))
    return PREPROCESSING.reduce(frame)
