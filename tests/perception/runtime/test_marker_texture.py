from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from touchcell.geometry.types import ImageArray
from touchcell.paths import MODELS
from touchcell.perception.models.model_file import load_model
from touchcell.perception.runtime.inference import ContactModel
from touchcell.perception.runtime.marker_texture import MarkerTexture
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.samples import Variation, contacts

FRAME = (480, 640)
Change = Callable[[ImageArray], ImageArray]


@pytest.fixture(scope="module")
def shipped() -> ContactModel:
    return ContactModel(load_model(MODELS / "sim_gdn.safetensors"))


@pytest.fixture(scope="module")
def frames() -> list[ImageArray]:
    """Camera frames of random contacts, up to the deepest of the public data."""
    renderer = FrameRenderer(seed=0)
    return [renderer.raw(each.pixels, i) for i, each in enumerate(contacts(40, 5, variation=Variation()))]


def _checkers(side_px: int) -> ImageArray:
    return ((np.indices(FRAME) // side_px).sum(axis=0) % 2 * 200).astype(np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros(FRAME, np.uint8),
        np.full(FRAME, 255, np.uint8),
        np.random.default_rng(0).integers(0, 256, FRAME).astype(np.uint8),
        *(_checkers(side) for side in (4, 8, 12, 16, 20, 30, 40, 60)),
    ],
    ids=["black", "white", "noise", *(f"checkers of {side} px" for side in (4, 8, 12, 16, 20, 30, 40, 60))],
)
def test_image_without_markers_is_out_of_range_for_the_shipped_network(
    shipped: ContactModel, image: ImageArray
) -> None:
    assert not shipped.predict(image).in_range
    assert not shipped.predict_batch([image])[0].in_range


def _left_half(level: int) -> Change:
    def change(image: ImageArray) -> ImageArray:
        other = image.copy()
        other[:, :320] = level
        return other

    return change


@pytest.mark.parametrize("change", [lambda image: 255 - image, _left_half(0), _left_half(60), _left_half(190)])
def test_inverted_and_half_frames_are_out_of_range(
    shipped: ContactModel, frames: list[ImageArray], change: Change
) -> None:
    assert not any(shipped.predict(change(each)).in_range for each in frames)


def _jpeg(image: ImageArray) -> ImageArray:
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 15])[1]
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _noisy(image: ImageArray) -> ImageArray:
    noise = np.random.default_rng(0).normal(0.0, 12.0, FRAME)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _dust(image: ImageArray) -> ImageArray:
    return np.asarray(cv2.circle(image.copy(), (300, 240), 25, (10.0,), -1), dtype=np.uint8)


def _dim(image: ImageArray) -> ImageArray:
    return (0.5 * image).astype(np.uint8)


@pytest.mark.parametrize("change", [lambda image: image, _jpeg, _noisy, _dust, _dim])
def test_light_noise_dust_and_compression_do_not_make_an_image_implausible(
    shipped: ContactModel, frames: list[ImageArray], change: Change
) -> None:
    assert shipped.reference is not None
    texture = MarkerTexture(shipped.reference)
    assert all(texture.plausible(shipped.reduce(change(each))) for each in frames)


def test_a_fifth_of_the_markers_may_be_missing(shipped: ContactModel) -> None:
    renderer = FrameRenderer(seed=1)
    assert shipped.reference is not None
    texture = MarkerTexture(shipped.reference)
    for i, each in enumerate(contacts(30, 6, variation=Variation(missing=0.2))):
        assert texture.plausible(shipped.reduce(renderer.raw(each.pixels, i)))


def test_reference_without_markers_cannot_be_used() -> None:
    assert not MarkerTexture(np.zeros((128, 128), np.uint8)).usable
