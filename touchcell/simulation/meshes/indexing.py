"""What the indices of a mesh tell: what is connected, which corners are at one place, which faces have no area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array


def connected(count: int, one: NDArray[np.integer], other: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return (count,) for each of ``count`` things the lowest number of those that links connect it with.

    Args:
        count: of the things.
        one, other: (k,) numbers of both ends of each link, which is there once.
    """
    label = np.arange(count)
    while True:
        least = label.copy()
        np.minimum.at(least, one, label[other])
        np.minimum.at(least, other, label[one])
        least = least[least]
        if np.array_equal(least, label):
            return label
        label = least


def coincident_as_one(vertices: Array, faces: NDArray[np.integer]) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (n, 3) of which no two are equal, and faces (m, 3) of them in the same order."""
    kept, label = np.unique(vertices, axis=0, return_inverse=True)
    return kept, label.ravel()[faces]


def has_three_corners(faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return (m,) whether the corners of each face (m, 3) are three; where two are one it has no area."""
    found: NDArray[np.bool_] = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return found
