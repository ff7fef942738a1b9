"""Contact detection, at a hundredth of the cost of a prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from touchcell.geometry.types import ImageArray
from touchcell.perception import kernels
from touchcell.perception.errors import ImageError

BLOCKS = 8
"""Number of blocks along each side in which the image is compared."""

CHANGE_PERCENT_PER_MM = 10.0
"""By which the score rises with the depth, on simulated images."""

MOST_CHANGED = 8
"""Number of the most changed blocks that decide: a first touch moves markers in an eighth of the image."""


class ContactGate:
    """Contact detector: compares preprocessed images with one taken out of contact, with hysteresis.

    The score of an image is the mean absolute difference from the reference, in grey levels over 255, in the blocks
    that differ most. Contact begins when it rises above ``enter`` and ends when it falls below ``leave``. On simulated
    128x128 images the score is 0.007 at rest with a noise of 3 grey levels, 0.023 at 0.2 mm depth, and from there rises
    by 0.1 per millimetre.

    Attributes:
        in_contact: result for the last image.
        score: score of the last image.
    """

    def __init__(self, reference: ImageArray, *, enter: float = 0.04, leave: float = 0.025) -> None:
        """Create a gate.

        Args:
            reference: uint8 (height, width), out of contact, as ``Preprocessing.reduce`` returns it; a model file may
                hold one (``ContactModel.reference``).
            enter: score, in (0, 1].
            leave: score, in (0, enter].

        Raises:
            ImageError: the reference is not such an image, or smaller than the blocks.
            ValueError: the scores are out of order.
        """
        if reference.dtype != np.uint8 or reference.ndim != 2 or min(reference.shape) < BLOCKS:
            raise ImageError("kind", f"uint8 (height, width), {BLOCKS} or more px", (reference.dtype, reference.shape))
        if not 0.0 < leave <= enter <= 1.0:
            raise ValueError(f"need 0 < leave <= enter <= 1, got leave {leave} and enter {enter}")
        self._reference = reference.copy()
        self._enter = enter
        self._leave = leave
        self.in_contact = False
        self.score = 0.0

    def take_zero(self, reduced: ImageArray) -> None:
        """Compare with this preprocessed image, taken out of contact, from now on.

        Raises:
            ImageError: the image is not of the reference's size.
        """
        self.compare(reduced)
        self._reference = reduced.copy()
        self.in_contact, self.score = False, 0.0

    @classmethod
    def from_frames(cls, frames: Sequence[ImageArray], *, margin: float = 3.0) -> Self:
        """Learn reference and noise from preprocessed images, all out of contact.

        Args:
            frames: two or more.
            margin: contact begins at this many times the largest score among the frames, and ends at two thirds of it.

        Raises:
            ImageError: the images differ in size, or are fewer than two.
        """
        if len(frames) < 2 or any(frame.shape != frames[0].shape for frame in frames):
            raise ImageError("list", "two or more images of one size", [frame.shape for frame in frames])
        reference = np.median(np.stack(frames), axis=0).astype(np.uint8)
        gate = cls(reference)
        # One grey level is the resolution of an 8-bit image.
        noise = max(1.0 / 255.0, *(gate.compare(frame) for frame in frames))
        enter = min(1.0, margin * noise)
        return cls(reference, enter=enter, leave=2.0 / 3.0 * enter)

    def compare(self, reduced: ImageArray) -> float:
        """Return the score of a preprocessed image, 0 for the reference itself, without changing the state.

        Raises:
            ImageError: the image is not of the reference's size.
        """
        if reduced.shape != self._reference.shape or reduced.dtype != np.uint8:
            raise ImageError("size", ("uint8", self._reference.shape), (str(reduced.dtype), reduced.shape))
        blocks = np.partition(kernels.block_changes(reduced, self._reference, BLOCKS).ravel(), -MOST_CHANGED)
        return float(blocks[-MOST_CHANGED:].mean() / 255.0)

    def update(self, reduced: ImageArray) -> bool:
        """Process the next image; return True if the sensor is in contact. Raises as ``compare``."""
        self.score = self.compare(reduced)
        self.in_contact = self.score > (self._leave if self.in_contact else self._enter)
        return self.in_contact
