"""Images for an emulated TacTip camera: white pins on a dark, slowly swaying skin, or a folder of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from touchcell.errors import ConfigError
from touchcell.geometry.types import ImageArray

PICTURES = 64
"""Images in the cycle; image k is shown in every frame with sequence number k modulo this."""

_RINGS = 10
_SWAY = 0.006
_NOISE_LEVELS = 3


@lru_cache(maxsize=256)
def synthetic(number: int, width: int, height: int) -> ImageArray:
    """Render image ``number`` of the cycle, (height, width) grey: 331 pins in 10 hexagonal rings, and sensor noise."""
    import cv2

    image = np.full((height, width), 24, np.uint8)
    phase = 2.0 * math.pi * number / PICTURES
    centre_x = width * (0.5 + _SWAY * math.cos(phase))
    centre_y = height * (0.5 + _SWAY * math.sin(phase))
    pitch = 0.045 * min(width, height)
    radius = max(1, round(0.2 * pitch))
    for ring in range(_RINGS + 1):
        for pin in range(max(1, 6 * ring)):
            angle = 2.0 * math.pi * pin / max(1, 6 * ring)
            place = (round(centre_x + ring * pitch * math.cos(angle)), round(centre_y + ring * pitch * math.sin(angle)))
            cv2.circle(image, place, radius, 230, -1)
    noise = np.random.default_rng(number).integers(0, _NOISE_LEVELS, image.shape, np.uint8)
    return np.asarray(image + noise, np.uint8)


@lru_cache(maxsize=256)
def from_file(path: Path, width: int, height: int) -> ImageArray:
    """Read an image file as (height, width) grey. Raises ConfigError."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ConfigError("is not an image", file=str(path), key="images", value=str(path))
    return resized(np.asarray(image, np.uint8), width, height)


def resized(image: ImageArray, width: int, height: int) -> ImageArray:
    """Resize to (height, width)."""
    import cv2

    return image if image.shape == (height, width) else np.asarray(cv2.resize(image, (width, height)), np.uint8)


def files(folder: Path) -> Sequence[Path]:
    """Return the image files of a folder, by name. Raises ConfigError if there are none."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp"))
    if not found:
        raise ConfigError("contains no images", file=str(folder), key="images", value=str(folder))
    return found


def brightened(image: ImageArray, factor: float) -> ImageArray:
    """Scale the brightness by ``factor``."""
    return image if factor == 1.0 else np.asarray(np.clip(image * factor, 0.0, 255.0), np.uint8)


def encoded(image: ImageArray, pixel_format: str) -> bytes:
    """Encode a grey image as a MJPG, YUYV or GREY frame."""
    import cv2

    if pixel_format == "GREY":
        return image.tobytes()
    if pixel_format == "YUYV":
        pairs = np.full((*image.shape, 2), 128, np.uint8)
        pairs[..., 0] = image
        return pairs.tobytes()
    data: bytes = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    return data
