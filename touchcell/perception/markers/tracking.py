"""Track the white discs through a sequence of images, without a displacement model and without training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import ImageError
from touchcell.perception.markers.detection import detect_markers, typical_size
from touchcell.perception.markers.matching import pair
from touchcell.perception.models.marker_architecture import MarkerSize

_REACH_SPACINGS = 0.45
_LEAST_FOLLOWED = 0.8


@dataclass(frozen=True, slots=True)
class TrackedMarkers:
    """Current positions of the discs of the first image.

    Attributes:
        reference: (m, 2) px in the first image.
        positions: (m, 2) px now; of lost discs their last position.
        seen: (m,) True if it has a disc in this image.
    """

    reference: Array
    positions: Array
    seen: NDArray[np.bool_]

    @property
    def followed(self) -> bool:
        """True if enough discs were found again to be reliable; False where images jump between contacts."""
        return float(self.seen.mean()) >= _LEAST_FOLLOWED


class MarkerTracker:
    """Track discs from the first image on, which should be out of contact.

    A disc may move by 0.45 of the spacing from one image to the next: a TacTip's, at 30 images per second, by 40 mm/s.
    The contacts of a data set, each far from the previous one, need ``MarkerMatcher``.

    Args:
        first: uint8 (height, width), black and white.

    Raises:
        ImageError: the image is not uint8 (height, width), or holds no discs.
    """

    def __init__(self, first: ImageArray) -> None:
        self._size: MarkerSize = typical_size(first)
        self._reference = detect_markers(first, self._size).centres
        if len(self._reference) < 2:
            raise ImageError("content", "markers", len(self._reference), hint="check threshold, focus and light")
        apart = np.linalg.norm(self._reference[:, None] - self._reference[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        self.spacing_px = float(np.median(apart.min(axis=1)))
        self._positions = self._reference.copy()

    def update(self, image: ImageArray) -> TrackedMarkers:
        """Return the discs in the next image. Raises ImageError where it is not uint8 (height, width)."""
        found = detect_markers(image, self._size).centres
        seen = np.zeros(len(self._positions), dtype=bool)
        if len(found):
            partner, seen = pair(self._positions, found, _REACH_SPACINGS * self.spacing_px)
            self._positions[seen] = found[partner[seen]]
        return TrackedMarkers(self._reference, self._positions.copy(), seen)
