"""Python implementation of ``_paint.c``: fallback where it is not built, and reference for its tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray

_FURTHEST_PX = 1e6


def paint(image: ImageArray, centres: Array, stamps: ImageArray) -> None:
    """Draw into ``image`` (height, width); each pixel becomes as bright as the brightest stamp on it.

    Args:
        image: image to draw into, clipped at its border.
        centres: (n, 2) px.
        stamps: (phases, phases, size, size) for sub-pixel offsets along v and u.
    """
    height, width = image.shape
    phases, size = len(stamps), stamps.shape[-1]
    centres = centres[(np.abs(centres) < _FURTHEST_PX).all(axis=1)]
    whole = np.floor(centres + 0.5)
    phase = np.minimum(((centres - whole + 0.5) * phases).astype(np.int64), phases - 1)
    corners = (whole - size // 2).astype(np.int64)
    for (left, top), (along_u, along_v) in zip(corners.tolist(), phase.tolist(), strict=True):
        right, bottom = left + size, top + size
        stamp = stamps[along_v, along_u, max(-top, 0) : max(height - top, 0), max(-left, 0) : max(width - left, 0)]
        area = image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
        np.maximum(area, stamp, out=area)


def expose(
    cover: ImageArray, contrast: ImageArray, background: ImageArray, noise: NDArray[np.int8], top: int, left: int
) -> ImageArray:
    """Return ``background + contrast * cover / 255`` (height, width), plus the window of ``noise`` at (top, left)."""
    import cv2

    height, width = cover.shape
    clean = cv2.add(cv2.multiply(cover, contrast, scale=1.0 / 255.0), background)
    grain: NDArray[np.int8] = np.ascontiguousarray(noise[top : top + height, left : left + width])
    return np.asarray(cv2.add(clean, grain, dtype=cv2.CV_8U), dtype=np.uint8)
