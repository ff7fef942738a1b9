"""Preprocessing from a camera image to the network input. Part of every model file, shared by training and serving."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchcell.geometry.types import ImageArray
from touchcell.perception import kernels
from touchcell.perception.errors import ImageError


class Crop(NamedTuple):
    """Rectangle of the input image, px; right and bottom are exclusive."""

    left: int
    top: int
    right: int
    bottom: int


class AdaptiveThreshold(BaseModel):
    """Adaptive threshold: white where a pixel exceeds its neighbourhood's mean less ``offset``.

    Attributes:
        block_px: side of the square neighbourhood, odd.
        offset: grey levels below the mean.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    block_px: int = Field(ge=3, le=255)
    offset: float = Field(allow_inf_nan=False)

    @model_validator(mode="after")
    def _odd(self) -> AdaptiveThreshold:
        if self.block_px % 2 == 0:
            raise ValueError("block_px must be odd")
        return self


class Preprocessing(BaseModel):
    """Preprocessing steps, in this order: crop, grey, median, threshold, mask, resize, scale to [0, 1].

    The paper's chain (Lloyd & Lepora 2024, 3.1.3) is a square crop, ``median_px=5``, an adaptive threshold and a
    resize to 128x128. The public data sets are published after the threshold, so only the resize is left for them.
    The resize decides a model's accuracy (errors grow three- to fivefold when it differs from training), hence area
    averaging, which keeps the sub-pixel position of a marker, is the default.

    Attributes:
        input_size: (height, width) px of the input images; others are refused.
        input_channels: 1 grey, 3 BGR.
        crop: region that is kept, or None for all of it.
        median_px: side of the median filter, odd, or None.
        threshold: adaptive threshold, or None.
        mask_radius_px: pixels further than this from the centre of the crop become black; None keeps all.
        output_size: (height, width) px of the result.
        interpolation: of the resize.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    input_size: tuple[int, int]
    input_channels: Literal[1, 3] = 1
    crop: Crop | None = None
    median_px: Literal[3, 5, 7, 9, 11] | None = None
    threshold: AdaptiveThreshold | None = None
    mask_radius_px: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    output_size: tuple[int, int] = (128, 128)
    interpolation: Literal["area", "linear", "nearest"] = "area"

    @model_validator(mode="after")
    def _fits(self) -> Preprocessing:
        if min(*self.input_size, *self.output_size) < 1:
            raise ValueError("sizes must be positive")
        if self.crop is not None:
            height, width = self.input_size
            left, top, right, bottom = self.crop
            if not (0 <= left < right <= width and 0 <= top < bottom <= height):
                raise ValueError(f"crop {tuple(self.crop)} does not lie within an image of {width}x{height}")
        return self

    @property
    def region(self) -> Crop:
        """The kept region of the image, all of it without a crop."""
        return self.crop or Crop(0, 0, self.input_size[1], self.input_size[0])

    def in_full_resolution(self) -> Preprocessing:
        """Return the same steps without the resize, for marker detection."""
        left, top, right, bottom = self.region
        return self.model_copy(update={"output_size": (bottom - top, right - left)})

    def reduce(self, image: ImageArray) -> ImageArray:
        """Apply all steps but the scaling; the result is cached in training.

        Args:
            image: uint8, ``input_size`` with ``input_channels``.

        Returns:
            uint8 (height, width) of ``output_size``.

        Raises:
            ImageError: the image is of another size, channel count or type.
        """
        import cv2

        self._check(image)
        if self.crop is not None:
            image = image[self.crop.top : self.crop.bottom, self.crop.left : self.crop.right]
        if image.ndim == 3:
            image = cast(ImageArray, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) if image.shape[2] == 3 else image[:, :, 0]
        if self.threshold is not None:
            if self.median_px not in (None, 5):
                image = _median(image, self.median_px)
            image = kernels.threshold(
                image, self.threshold.block_px, self.threshold.offset, of_median_5=self.median_px == 5
            )
        elif self.median_px is not None:
            image = _median(image, self.median_px)
        if self.mask_radius_px is not None:
            image = image * _disc(image.shape[0], image.shape[1], self.mask_radius_px)
        if image.shape == self.output_size:
            return image
        if self.interpolation == "area":
            return kernels.area_means(image, self.output_size)
        height, width = self.output_size
        method = cv2.INTER_LINEAR if self.interpolation == "linear" else cv2.INTER_NEAREST
        return cast(ImageArray, cv2.resize(image, (width, height), interpolation=method))

    def apply(self, image: ImageArray) -> NDArray[np.float32]:
        """Return the network input: float32 (1, height, width) in [0, 1]. Raises as ``reduce``."""
        return scale(self.reduce(image))[None]

    def _check(self, image: ImageArray) -> None:
        if not isinstance(image, np.ndarray):
            raise ImageError("type", "numpy.ndarray", type(image).__name__)
        if image.dtype != np.uint8:
            raise ImageError("dtype", "uint8", str(image.dtype))
        if image.ndim not in (2, 3):
            raise ImageError("shape", "(height, width) or (height, width, 3)", image.shape)
        channels = 1 if image.ndim == 2 else image.shape[2]
        if channels != self.input_channels:
            raise ImageError(
                "channels", self.input_channels, channels, hint="grey and colour cameras need their own models"
            )
        if image.shape[:2] != self.input_size:
            raise ImageError(
                "size",
                self.input_size,
                image.shape[:2],
                hint="set the camera to the (height, width) that the model was trained for, or train a model for it",
            )


def _median(image: ImageArray, side_px: int) -> ImageArray:
    import cv2

    if side_px == 5:
        return kernels.median_5(image)
    return cast(ImageArray, cv2.medianBlur(np.ascontiguousarray(image), side_px))


def scale(reduced: ImageArray) -> NDArray[np.float32]:
    """Scale grey levels 0-255 to float32 in [0, 1], any shape."""
    return np.multiply(reduced, np.float32(1.0 / 255.0), dtype=np.float32)


@lru_cache(maxsize=4)
def _disc(height: int, width: int, radius_px: float) -> ImageArray:
    y, x = np.ogrid[:height, :width]
    inside = (y - (height - 1) / 2) ** 2 + (x - (width - 1) / 2) ** 2 <= radius_px**2
    disc: ImageArray = inside.astype(np.uint8)
    disc.setflags(write=False)
    return disc
