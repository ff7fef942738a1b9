"""Marker matching in the images of a data set, without its labels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.drivers.replay.dataset import FRAME_SIZE, PUBLIC_CROP, Split, read_image, read_split
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import ImageError
from touchcell.perception.markers.detection import detect_markers
from touchcell.perception.markers.matching import MarkerField, MarkerMatcher
from touchcell.perception.models.marker_architecture import MarkerSize
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.marker_learning import learn_markers
from touchcell.perception.networks.marker_training import preprocessing_and_size

_BELIEVED = 0.97

StageCallback = Callable[[str, int, int], None]
"""Called with the name of the stage, the number of items done, and the total."""


@dataclass(frozen=True)
class SensorMarkers:
    """Marker detector and matcher of one sensor.

    Attributes:
        preprocessing: camera image to black and white.
        size: of a marker.
        matcher: discs to markers.
        origin: (2,) px, position of the images' first pixel in the 640x480 frame.
        disc_radius_px: of a circle with the median area of the discs.
    """

    preprocessing: Preprocessing
    size: MarkerSize
    matcher: MarkerMatcher
    origin: Array
    disc_radius_px: float

    @property
    def reference(self) -> Array:
        """(m, 2) px of the undeformed lattice in the 640x480 frame."""
        reference: Array = self.matcher.model.reference + self.origin
        return reference

    def field(self, image: ImageArray) -> MarkerField:
        """Match the markers of one image, in its own pixels."""
        return self.matcher.match(detect_markers(self.preprocessing.reduce(image), self.size))

    def contacts(
        self, split: Split, which: NDArray[np.intp], progress: StageCallback | None = None
    ) -> tuple[MarkedContacts, NDArray[np.intp]]:
        """Match the markers of some images, in the 640x480 frame, and drop uncertain matches.

        Args:
            split: labelled images.
            which: (n,) indices of the images.
            progress: called per image.

        Returns:
            The contacts with reliable matches, and their indices.
        """
        kept, pixels, seen = [], [], []
        for i, number in enumerate(which):
            field = self.field(read_image(split.images[int(number)]))
            if field.valid and field.score >= _BELIEVED:
                kept.append(int(number))
                pixels.append(field.positions + self.origin)
                seen.append(field.seen)
            if progress is not None:
                progress("matched", i + 1, len(which))
        labels = se3.from_euler_mm_deg(split.contact_mm_deg[kept])
        return MarkedContacts(labels, np.array(pixels), np.array(seen, bool)), np.array(kept, np.intp)


def frame_origin(size: tuple[int, int], crop: tuple[int, int, int, int] | None = None) -> Array:
    """Return (2,) px, the position of the first pixel of images of this (height, width) in the 640x480 frame.

    Args:
        size: of the images.
        crop: (left, top, right, bottom) px that is recorded beside them.

    Raises:
        ImageError: they are neither whole frames nor the recorded or the public crop.
    """
    if size == FRAME_SIZE[::-1]:
        return np.zeros(2)
    for left, top, right, bottom in (PUBLIC_CROP,) if crop is None else (crop, PUBLIC_CROP):
        if size == (bottom - top, right - left):
            return np.array([left, top], dtype=np.float64)
    left, top, right, bottom = crop or PUBLIC_CROP
    expected = (
        f"{FRAME_SIZE[::-1]} or the {'public' if crop is None else 'recorded'} crop {(bottom - top, right - left)}"
    )
    raise ImageError("size", expected, size, hint="record whole 640x480 frames")


def learn_sensor(
    data: Path, *, images: int, rings: int, guess_steps: int = 600, seed: int = 0, progress: StageCallback | None = None
) -> SensorMarkers:
    """Learn to match the markers from evenly chosen images of ``data/train``, without using their labels.

    Args:
        data: data set.
        images: number of images.
        rings: of the lattice.
        guess_steps: as of ``marker_learning.learn_markers``.
        seed: of everything random.
        progress: called per image and learning step.

    Raises:
        DataError: the data set is damaged.
        TrainingError: as ``marker_learning.learn_markers``.
        ImageError: the images are neither whole frames nor the public crop.
    """
    split = read_split(data, "train")
    chosen = [split.images[i] for i in evenly(len(split.images), images)]
    first = read_image(chosen[0])
    origin = frame_origin((first.shape[0], first.shape[1]), split.crop)
    preprocessing, size = preprocessing_and_size(map(read_image, chosen))
    discs = []
    for i, path in enumerate(chosen):
        discs.append(detect_markers(preprocessing.reduce(read_image(path)), size))
        if progress is not None:
            progress("images", i + 1, len(chosen))
    learned = learn_markers(
        discs,
        preprocessing.output_size,
        rings=rings,
        guess_steps=guess_steps,
        seed=seed,
        progress=None if progress is None else lambda done, total: progress("markers learned", done, total),
    )
    area = float(np.median(np.concatenate([each.areas for each in discs])))
    return SensorMarkers(preprocessing, size, learned.matcher, origin, float(np.sqrt(area / np.pi)))


def evenly(n: int, wanted: int) -> list[int]:
    """Return ``wanted`` evenly spaced numbers below ``n``, neither the first nor the last where there is a choice."""
    if wanted >= n:
        return list(range(n))
    return [int(each) for each in np.linspace(0, n - 1, wanted + 2).round()[1:-1]]


@dataclass(frozen=True)
class MarkedContacts:
    """Commanded contacts, and the marker positions observed in them.

    Attributes:
        T_f_s: (n, 4, 4) commanded.
        pixels: (n, m, 2) px.
        seen: (n, m) markers that were detected.
    """

    T_f_s: Array
    pixels: Array
    seen: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.T_f_s)

    def chosen(self, which: Any) -> MarkedContacts:
        """Return some of the contacts."""
        return MarkedContacts(self.T_f_s[which], self.pixels[which], self.seen[which])
