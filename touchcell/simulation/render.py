"""Render marker images: anti-aliased discs, drawn from stamps precomputed for many sub-pixel offsets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from touchcell.compiled import extension
from touchcell.drivers.replay.dataset import FRAME_SIZE, PUBLIC_CROP
from touchcell.geometry.types import Array, ImageArray
from touchcell.simulation import _plain_paint


class _Kernels(Protocol):
    """Interface of the compiled and the plain module."""

    def paint(self, image: ImageArray, centres: Array, stamps: ImageArray, /) -> None: ...
    def expose(
        self,
        cover: ImageArray,
        contrast: ImageArray,
        background: ImageArray,
        noise: NDArray[np.int8],
        top: int,
        left: int,
        /,
    ) -> ImageArray: ...


_kernels = cast(_Kernels, extension("touchcell.simulation._paint") or _plain_paint)

Seed = int | tuple[int, ...]

_ROWS = 4


class Stamps:
    """A disc of one radius, drawn with its centre at any sub-pixel position.

    Args:
        radius_px: radius of the disc.
        phases: sub-pixel offsets per axis; the centre error is at most 1 / (2 phases) px per axis.
    """

    def __init__(self, radius_px: float, phases: int = 64) -> None:
        self._phases = phases
        self.reach = math.ceil(radius_px + 0.5)
        grid = np.arange(-self.reach, self.reach + 1)
        offsets = (np.arange(phases) + 0.5) / phases - 0.5
        u = (grid[None, :] - offsets[:, None]).astype(np.float32)
        # Coverage is exact along u, where a row of the disc is a chord, and averaged over rows of a pixel along v.
        coverage = np.zeros((phases, phases, grid.size, grid.size), np.float32)
        for row in (np.arange(_ROWS) + 0.5) / _ROWS - 0.5:
            half = np.sqrt(np.maximum(radius_px**2 - (u + row) ** 2, 0.0))[:, None, :, None]
            across = u[None, :, None, :]
            coverage += np.clip(np.minimum(across + 0.5, half) - np.maximum(across - 0.5, -half), 0.0, 1.0)
        coverage *= 255.0 / _ROWS
        self.stamps = np.round(coverage).astype(np.uint8)
        self.stamps.setflags(write=False)

    def paint(self, image: ImageArray, centres: Array) -> None:
        """Draw white discs at ``centres`` (n, 2) px into a grey ``image``, clipped at its border."""
        _kernels.paint(image, np.ascontiguousarray(centres, dtype=np.float64), self.stamps)


@lru_cache(maxsize=8)
def _stamps(radius_px: float) -> Stamps:
    """Return the stamps of one radius, read-only: sensors of one kind share them."""
    return Stamps(radius_px)


@dataclass(frozen=True, slots=True)
class Lighting:
    """Illumination and optics of the sensor's camera. Grey levels of 255.

    Attributes:
        background: grey level of the skin at the image centre.
        pin: grey level of a pin at the image centre.
        vignetting: fraction of brightness lost in the corners.
        noise: standard deviation of the sensor noise.
        exposure: factor on the grey levels before the noise.
        blur_px: standard deviation of the lens's blur, 0 for none.
    """

    background: float = 60.0
    pin: float = 190.0
    vignetting: float = 0.25
    noise: float = 2.0
    exposure: float = 1.0
    blur_px: float = 0.0


class FrameRenderer:
    """Renderer of raw 640x480 camera frames and of the public, thresholded images.

    Args:
        disc_radius_px: radius of the pins in the frame.
        lighting: grey levels.
        seed: seed of the noise.
    """

    def __init__(self, disc_radius_px: float = 6.2, lighting: Lighting | None = None, seed: Seed = 0) -> None:
        light = lighting or Lighting()
        width, height = FRAME_SIZE
        self._stamps = _stamps(disc_radius_px)
        v, u = np.mgrid[:height, :width]
        corner = math.hypot(width, height) / 2.0
        fade = 1.0 - light.vignetting * ((u - width / 2.0) ** 2 + (v - height / 2.0) ** 2) / corner**2
        background = np.minimum(np.round(light.exposure * light.background * fade), 255.0)
        pin = np.minimum(np.round(light.exposure * light.pin * fade), 255.0)
        self._background = background.astype(np.uint8)
        self._contrast = (pin - background).astype(np.uint8)
        self._blur_px = light.blur_px
        self._seed = (seed,) if isinstance(seed, int) else tuple(seed)
        # Drawing 307 200 normal numbers takes longer than the rest of the frame, so frames use windows of one sheet.
        sheet = np.random.default_rng(self._seed).normal(0.0, light.noise, (height + 64, width + 64))
        self._noise = np.clip(np.round(sheet), -128, 127).astype(np.int8)

    def raw(self, pixels: Array, frame: int = 0) -> ImageArray:
        """Render a grey frame (480, 640) with discs at ``pixels`` (n, 2); ``frame`` selects the noise."""
        import cv2

        width, height = FRAME_SIZE
        cover = np.zeros((height, width), np.uint8)
        self._stamps.paint(cover, pixels)
        top, left = np.random.default_rng((*self._seed, frame)).integers(0, 65, 2).tolist()
        if not self._blur_px:
            return _kernels.expose(cover, self._contrast, self._background, self._noise, top, left)
        lit = _kernels.expose(cover, self._contrast, self._background, np.zeros_like(self._noise), 0, 0)
        grain: NDArray[np.int8] = np.ascontiguousarray(self._noise[top : top + height, left : left + width])
        return np.asarray(cv2.add(cv2.GaussianBlur(lit, (0, 0), self._blur_px), grain, dtype=cv2.CV_8U), dtype=np.uint8)

    def processed(self, pixels: Array) -> ImageArray:
        """Render a binary image (440, 445) as in the public data: cropped by PUBLIC_CROP and thresholded."""
        left, top, right, bottom = PUBLIC_CROP
        cover = np.zeros((bottom - top, right - left), np.uint8)
        self._stamps.paint(cover, pixels - np.array([left, top], dtype=np.float64))
        return np.where(cover > 127, np.uint8(255), np.uint8(0))
