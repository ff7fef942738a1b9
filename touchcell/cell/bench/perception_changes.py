"""Changes of camera frames with which ``touchcell bench perception`` counts false accepts and false rejects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from touchcell.geometry.types import Array, ImageArray

Change = Callable[[ImageArray, ImageArray, np.random.Generator], ImageArray]
"""From a frame and another frame of the same sensor, both grey (height, width), to the changed frame."""


@dataclass(frozen=True)
class FrameChange:
    """One change of camera frames.

    Attributes:
        name: for the table.
        wanted: ``keep`` where the frame shows the contact as the model's camera would, ``refuse`` where it does not.
        apply: the change.
    """

    name: str
    wanted: Literal["refuse", "keep"]
    apply: Change


def _warped(frame: ImageArray, matrix: Array) -> ImageArray:
    height, width = frame.shape
    border = float(np.median(frame[:8]))
    return np.asarray(cv2.warpAffine(frame, matrix, (width, height), flags=cv2.INTER_CUBIC, borderValue=(border,)))


def _moved(zoom: float = 1.0, turn_deg: float = 0.0, shift_px: float = 0.0) -> Change:
    """Zoom and turn by these amounts with a random sign, shift in a random direction, about the frame's centre."""

    def change(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
        height, width = frame.shape
        factor = zoom if rng.random() < 0.5 else 1.0 / zoom
        matrix = cv2.getRotationMatrix2D((width / 2 - 0.5, height / 2 - 0.5), turn_deg * rng.choice([-1, 1]), factor)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        matrix[:, 2] += shift_px * np.array([np.cos(angle), np.sin(angle)])
        return _warped(frame, matrix)

    return change


def _turned(sixths: int, *, mirrored: bool = False) -> Change:
    """Turn about the frame's centre by a multiple of 60 degrees, after a reflection."""

    def change(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
        height, width = frame.shape
        image = np.ascontiguousarray(frame[:, ::-1]) if mirrored else frame
        return _warped(image, cv2.getRotationMatrix2D((width / 2 - 0.5, height / 2 - 0.5), 60.0 * sixths, 1.0))

    return change


def _upside_down(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    return np.ascontiguousarray(frame[::-1, ::-1])


def _torn(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Replace one half, cut along a row or a column, by that of another frame."""
    torn = frame.copy()
    height, width = frame.shape
    if rng.random() < 0.5:
        torn[: height // 2] = other[: height // 2]
    else:
        torn[:, : width // 2] = other[:, : width // 2]
    return torn


def _half_rolled(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    rolled = frame.copy()
    half = frame.shape[0] // 2
    rolled[half:] = np.roll(frame[half:], 40, axis=1)
    return rolled


def _rolled(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    return np.roll(frame, int(rng.integers(40, frame.shape[1] - 40)), axis=1)


def _half(level: int) -> Change:
    def change(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
        covered = frame.copy()
        height, width = frame.shape
        if rng.random() < 0.5:
            covered[:, : width // 2] = level
        else:
            covered[height // 2 :] = level
        return covered

    return change


def _constant(level: int) -> Change:
    return lambda frame, other, rng: np.full_like(frame, level)


def _noise(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    return rng.integers(0, 256, frame.shape).astype(np.uint8)


def _checkers(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    side = int(rng.integers(8, 41))
    squares: ImageArray = ((np.indices(frame.shape) // side).sum(axis=0) % 2 * 200).astype(np.uint8)
    return squares


def _inverted(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    inverted: ImageArray = 255 - frame
    return inverted


def _discs_at(frame: ImageArray, places: Array, radius_px: float) -> ImageArray:
    dark, bright = int(np.percentile(frame, 20)), int(np.percentile(frame, 97))
    image = np.full(frame.shape, dark, np.uint8)
    for u, v in np.round(16 * places).astype(int).tolist():
        cv2.circle(image, (u, v), round(16 * radius_px), (bright,), -1, cv2.LINE_AA, 4)
    return image


def _square_grid(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    height, width = frame.shape
    spacing = rng.uniform(17.0, 26.0)
    i, j = np.meshgrid(np.arange(-12, 13), np.arange(-12, 13))
    turn = np.exp(1j * rng.uniform(0.0, np.pi / 2))
    flat = spacing * (i + 1j * j).ravel() * turn
    flat = flat[np.abs(flat) < 0.45 * height] + rng.uniform(-10, 10) + width / 2 + 1j * (height / 2)
    return _discs_at(frame, np.column_stack([flat.real, flat.imag]), 0.3 * spacing)


def _hexagonal_grid(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Discs of a hexagonal lattice of 7 rings that fills the frame: the tip of another make."""
    height, width = frame.shape
    spacing = 0.45 * height / 7
    i, j = np.meshgrid(np.arange(-8, 9), np.arange(-8, 9))
    flat = spacing * (i + j * np.exp(1j * np.pi / 3)).ravel() * np.exp(1j * rng.uniform(0.0, np.pi / 3))
    flat = flat[np.abs(flat) < 0.46 * height] + width / 2 + 1j * (height / 2)
    return _discs_at(frame, np.column_stack([flat.real, flat.imag]), 0.28 * spacing)


def _other_crop(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Show another region of the sensor's image, as a camera with another resolution or lens does."""
    height, width = frame.shape
    angle = rng.uniform(0.0, 2.0 * np.pi)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 0.0, float(rng.choice([0.8, 1.25])))
    matrix[:, 2] += 50.0 * np.array([np.cos(angle), np.sin(angle)])
    return _warped(frame, matrix)


def _dead_pins(share: float) -> Change:
    """Paint over the discs of a share of the pins, the same ones for the same random generator."""

    def change(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
        dark = np.percentile(frame, 20)
        white = (frame > 0.5 * (dark + np.percentile(frame, 97))).astype(np.uint8)
        _, parts, stats, _centres = cv2.connectedComponentsWithStats(white)
        markers = np.flatnonzero((stats[1:, cv2.CC_STAT_AREA] > 20) & (stats[1:, cv2.CC_STAT_AREA] < 500)) + 1
        lost = markers[rng.random(len(markers)) < share]
        painted = frame.copy()
        mask = cv2.dilate(np.isin(parts, lost).astype(np.uint8), np.ones((5, 5), np.uint8))
        painted[mask > 0] = np.uint8(dark)
        return painted

    return change


def _dust(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Cover a random place of the tip by a black speck with a radius of 25 px."""
    height, width = frame.shape
    angle, r = rng.uniform(0.0, 2.0 * np.pi), 0.35 * height * np.sqrt(rng.random())
    centre = (int(width / 2 + r * np.cos(angle)), int(height / 2 + r * np.sin(angle)))
    return np.asarray(cv2.circle(frame.copy(), centre, 25, (10.0,), -1), dtype=np.uint8)


def _light(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Multiply by a gradient from 0.4 to 1.3 across the frame, in a random direction."""
    height, width = frame.shape
    v, u = np.mgrid[:height, :width] / np.array([[[height]], [[width]]]) - 0.5
    angle = rng.uniform(0.0, 2.0 * np.pi)
    gain = 0.85 + 0.64 * (np.cos(angle) * u + np.sin(angle) * v)
    lit: ImageArray = np.clip(gain * frame, 0, 255).astype(np.uint8)
    return lit


def _gain(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    lit: ImageArray = np.clip(rng.uniform(0.5, 1.3) * frame, 0, 255).astype(np.uint8)
    return lit


def _noisy(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    return np.clip(frame + rng.normal(0.0, 12.0, frame.shape), 0, 255).astype(np.uint8)


def _jpeg(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 20])[1]
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _unchanged(frame: ImageArray, other: ImageArray, rng: np.random.Generator) -> ImageArray:
    return frame


CHANGES: tuple[FrameChange, ...] = (
    FrameChange("black", "refuse", _constant(0)),
    FrameChange("white", "refuse", _constant(255)),
    FrameChange("noise alone", "refuse", _noise),
    FrameChange("checkers", "refuse", _checkers),
    FrameChange("inverted", "refuse", _inverted),
    FrameChange("torn: half of another frame", "refuse", _torn),
    FrameChange("half rolled by 40 px", "refuse", _half_rolled),
    FrameChange("rolled", "refuse", _rolled),
    FrameChange("square grid of dots", "refuse", _square_grid),
    FrameChange("7 rings", "refuse", _hexagonal_grid),
    FrameChange("another crop", "refuse", _other_crop),
    FrameChange("half black", "refuse", _half(0)),
    FrameChange("half grey", "refuse", _half(70)),
    FrameChange("half white", "refuse", _half(220)),
    FrameChange("zoom by 5 %", "refuse", _moved(zoom=1.05)),
    FrameChange("shift by 10 px", "refuse", _moved(shift_px=10.0)),
    FrameChange("turn by 5 deg", "refuse", _moved(turn_deg=5.0)),
    FrameChange("upside down", "refuse", _upside_down),
    FrameChange("turned by 60 deg", "refuse", _turned(1)),
    FrameChange("mirrored", "refuse", _turned(0, mirrored=True)),
    FrameChange("unchanged", "keep", _unchanged),
    FrameChange("5 % dead pins", "keep", _dead_pins(0.05)),
    FrameChange("10 % dead pins", "keep", _dead_pins(0.1)),
    FrameChange("20 % dead pins", "keep", _dead_pins(0.2)),
    FrameChange("dust", "keep", _dust),
    FrameChange("light gradient", "keep", _light),
    FrameChange("light 0.5 to 1.3", "keep", _gain),
    FrameChange("noise", "keep", _noisy),
    FrameChange("JPEG", "keep", _jpeg),
)
"""All changes; those to be refused first."""
