from __future__ import annotations

import hashlib

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from touchcell.perception.errors import ImageError
from touchcell.perception.models.preprocessing import AdaptiveThreshold, Crop, Preprocessing, scale


def speckled(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(7).integers(0, 256, (height, width), dtype=np.uint8)


def area_means(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return exact means over output pixels, through the integral image, in float64."""

    def integrate(values: np.ndarray, n: int) -> np.ndarray:
        total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
        edges = np.arange(n + 1) * (len(values) / n)
        below = np.minimum(edges.astype(int), len(values) - 1)
        ends = total[below] + (total[below + 1] - total[below]) * (edges - below)[:, None]
        return np.diff(ends, axis=0) * (n / len(values))

    return integrate(integrate(image.astype(float), height).T, width).T


def test_area_resize_is_the_mean_over_each_pixel() -> None:
    image = speckled(440, 445)
    reduced = Preprocessing(input_size=(440, 445)).reduce(image)
    assert np.abs(reduced - area_means(image, 128, 128)).max() <= 0.501


def test_area_resize_of_public_size_is_pinned_to_the_bit() -> None:
    reduced = Preprocessing(input_size=(440, 445)).reduce(255 * (speckled(440, 445) > 196).astype(np.uint8))
    assert hashlib.sha256(reduced.tobytes()).hexdigest() == (
        "20892b4eff6794a0a6f3149d1f7be2aef766d88df1d63992961706a5a59f253a"
    )


def test_the_papers_chain_is_made_in_order_after_the_crop() -> None:
    image = np.random.default_rng(3).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    steps = Preprocessing(
        input_size=(48, 64),
        input_channels=3,
        crop=Crop(10, 4, 50, 44),
        median_px=5,
        threshold=AdaptiveThreshold(block_px=11, offset=-3.0),
        output_size=(20, 20),
    )
    grey = cv2.medianBlur(cv2.cvtColor(image[4:44, 10:50], cv2.COLOR_BGR2GRAY), 5)
    binary = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 11, -3.0)
    assert set(np.unique(binary)) == {0, 255}
    np.testing.assert_array_equal(steps.reduce(image), binary.reshape(20, 2, 20, 2).mean(axis=(1, 3)).round())


def test_mask_blackens_what_lies_outside_the_circle() -> None:
    steps = Preprocessing(input_size=(21, 31), mask_radius_px=8.0, output_size=(21, 31))
    masked = steps.reduce(np.full((21, 31), 200, dtype=np.uint8))
    assert masked[10, 15 + 8] == masked[10 - 8, 15] == 200
    assert masked[10, 15 + 9] == masked[10 - 9, 15] == masked[0, 0] == 0


def test_interpolation_is_part_of_the_result() -> None:
    image = speckled(100, 100)
    results = {
        name: Preprocessing(input_size=(100, 100), output_size=(30, 30), interpolation=name).reduce(image).tobytes()
        for name in ("area", "linear", "nearest")
    }
    assert len(set(results.values())) == 3


def test_apply_scales_to_one_channel_between_zero_and_one() -> None:
    image = np.array([[0, 255], [51, 102]], dtype=np.uint8)
    applied = Preprocessing(input_size=(2, 2), output_size=(2, 2)).apply(image)
    assert applied.shape == (1, 2, 2)
    assert applied.dtype == np.float32
    np.testing.assert_allclose(applied[0], [[0.0, 1.0], [0.2, 0.4]], rtol=1e-6)
    assert scale(np.arange(256, dtype=np.uint8)).max() <= 1.0


@pytest.mark.parametrize(
    ("image", "attribute"),
    [
        (np.zeros((40, 41), np.uint8), "size"),
        (np.zeros((40, 40, 3), np.uint8), "channels"),
        (np.zeros((40, 40), np.float32), "dtype"),
        (np.zeros(40, np.uint8), "shape"),
        ([[0, 1]], "type"),
        (None, "type"),
    ],
)
def test_other_images_are_refused(image: object, attribute: str) -> None:
    with pytest.raises(ImageError) as caught:
        Preprocessing(input_size=(40, 40)).apply(image)
    assert caught.value.attribute == attribute


def test_round_trips_through_json_and_is_immutable() -> None:
    steps = Preprocessing(
        input_size=(480, 640),
        crop=Crop(1, 2, 300, 400),
        median_px=5,
        threshold=AdaptiveThreshold(block_px=61, offset=5),
    )
    assert Preprocessing.model_validate_json(steps.model_dump_json()) == steps
    with pytest.raises(ValidationError):
        steps.median_px = 3


@pytest.mark.parametrize(
    "fields",
    [
        {"crop": (0, 0, 641, 480)},
        {"crop": (10, 10, 10, 20)},
        {"median_px": 4},
        {"threshold": {"block_px": 10, "offset": 0.0}},
        {"threshold": {"block_px": 11, "offset": float("nan")}},
        {"mask_radius_px": -1.0},
        {"output_size": (0, 128)},
        {"blur": 3},
    ],
)
def test_impossible_steps_are_refused(fields: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Preprocessing.model_validate({"input_size": (480, 640), **fields})


def test_full_resolution_keeps_every_pixel_of_the_crop() -> None:
    steps = Preprocessing(
        input_size=(480, 640), crop=Crop(105, 20, 550, 460), threshold=AdaptiveThreshold(block_px=61, offset=-5.0)
    )
    full = steps.in_full_resolution()
    assert full.output_size == (440, 445)
    assert full.model_copy(update={"output_size": (128, 128)}) == steps
    assert Preprocessing(input_size=(44, 48)).in_full_resolution().output_size == (44, 48)
