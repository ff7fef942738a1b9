"""Sub-pixel detection of the white discs of a tactile image, and their lattice."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception import kernels
from touchcell.perception.errors import ImageError
from touchcell.perception.models.marker_architecture import MarkerSize

_WORTH_A_LOOK_PX = 20


@dataclass(frozen=True, slots=True)
class Discs:
    """White discs found in an image.

    Attributes:
        centres: (n, 2) px, (u, v); pixel centres are whole numbers.
        areas: (n,) px.
    """

    centres: Array
    areas: Array

    def __len__(self) -> int:
        return len(self.areas)


def detect_markers(image: ImageArray, size: MarkerSize) -> Discs:
    """Return the centroids of the connected white components that have the size of a marker.

    In black and white images of discs drawn at known positions, the median error of a centroid is 0.07 px.

    Args:
        image: uint8 (height, width); non-zero is white.
        size: bounds on the components.

    Returns:
        The discs; none when the image is black, white or nothing but noise.

    Raises:
        ImageError: the image is not uint8 (height, width).
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 2:
        found = (getattr(image, "dtype", type(image)), getattr(image, "shape", None))
        raise ImageError("kind", "uint8 (height, width)", found)
    if not image.size:
        return Discs(np.empty((0, 2)), np.empty(0))
    return Discs(*kernels.discs(image, size.smallest_px, size.largest_px, size.longest_side_px))


def typical_size(image: ImageArray) -> MarkerSize:
    """Return bounds on the discs of an image, from the median of its larger components.

    Raises:
        ImageError: the image is not uint8 (height, width), or holds no discs.
    """
    anything = MarkerSize(
        smallest_px=_WORTH_A_LOOK_PX, largest_px=image.size, longest_side_px=max(1, max(image.shape) // 8)
    )
    discs = detect_markers(image, anything)
    if len(discs) < 7:
        raise ImageError("content", "7 markers or more", len(discs), hint="check threshold, focus and light")
    return MarkerSize.of_disc(float(np.median(discs.areas)))


def lattice(rings: int) -> Array:
    """Return (markers, 2) marker positions of a flat lattice: one in the centre, 6k evenly on ring k at radius k.

    The TacTip's ten rings hold 331 markers.
    """
    points = [np.zeros((1, 2))]
    for k in range(1, rings + 1):
        azimuth = np.arange(6 * k) * (2.0 * np.pi / (6 * k))
        points.append(k * np.column_stack([np.cos(azimuth), np.sin(azimuth)]))
    return np.concatenate(points)


def rings_of(markers: int) -> int:
    """Return the rings of a lattice of about that many markers: k rings have 1 + 3 k (k + 1)."""
    return round((math.sqrt(max(12 * markers - 3, 9)) - 3.0) / 6.0)


def ring_numbers(rings: int) -> Array:
    """Return the (markers,) ring of each marker of ``lattice``, as floats."""
    return np.concatenate([np.full(max(1, 6 * k), float(k)) for k in range(rings + 1)])
