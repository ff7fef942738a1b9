import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.compiled import extension
from touchcell.drivers.replay.dataset import PUBLIC_CROP
from touchcell.geometry import se3
from touchcell.simulation import _plain_paint
from touchcell.simulation.render import FrameRenderer, Lighting, Stamps
from touchcell.simulation.tip import Tip

STAMPS = Stamps(6.2)
PIXELS = Tip().pixels(se3.from_euler_mm_deg([1, 2, 4, 5, -8, 2]))


def centroid(image: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    weight = image.astype(np.float64)
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@given(u=st.floats(8, 32), v=st.floats(8, 32))
def test_a_disc_is_centred_to_a_fiftieth_of_a_pixel(u: float, v: float) -> None:
    image = np.zeros((41, 41), np.uint8)
    STAMPS.paint(image, np.array([[u, v]]))
    assert np.linalg.norm(centroid(image) - [u, v]) < 0.02
    assert image.sum() / 255 == pytest.approx(np.pi * 6.2**2, rel=0.01)


# Whole sixteenths: nothing is lost when 40 is added.
@given(u=st.integers(-320, 960).map(lambda n: n / 16), v=st.integers(-320, 960).map(lambda n: n / 16))
def test_discs_are_clipped_at_the_border(u: float, v: float) -> None:
    image = np.zeros((41, 41), np.uint8)
    STAMPS.paint(image, np.array([[u, v]]))
    framed = np.zeros((121, 121), np.uint8)
    STAMPS.paint(framed, np.array([[u + 40, v + 40]]))
    np.testing.assert_array_equal(image, framed[40:81, 40:81])


def test_touching_discs_do_not_erase_or_add_up() -> None:
    one, other, both = (np.zeros((41, 41), np.uint8) for _ in range(3))
    STAMPS.paint(one, np.array([[15.0, 20.0]]))
    STAMPS.paint(other, np.array([[22.3, 20.4]]))
    STAMPS.paint(both, np.array([[15.0, 20.0], [22.3, 20.4]]))
    np.testing.assert_array_equal(both, np.maximum(one, other))


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_compiled_kernels_draw_the_same_as_plain_ones(seed: int) -> None:
    compiled = extension("touchcell.simulation._paint")
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-30.0, 110.0, (60, 2))
    centres[:4] = [[np.nan, 5.0], [np.inf, 5.0], [5.0, -1e300], [80.0, 60.0]]
    covers = []
    for kernels in (compiled, _plain_paint):
        covers.append(np.zeros((60, 80), np.uint8))
        kernels.paint(covers[-1], centres, STAMPS.stamps)
    np.testing.assert_array_equal(*covers)
    assert covers[0].max() == 255
    contrast, background = rng.integers(0, 256, (2, 60, 80), np.uint8)
    noise = rng.integers(-128, 128, (64, 90), np.int8)
    layers = (rng.integers(0, 256, (60, 80), np.uint8), contrast, background, noise, 4, 10)
    np.testing.assert_array_equal(compiled.expose(*layers), _plain_paint.expose(*layers))


def test_compiled_kernels_refuse_unsupported_arrays() -> None:
    compiled = extension("touchcell.simulation._paint")
    image = np.zeros((60, 80), np.uint8)
    frozen = image.copy()
    frozen.flags.writeable = False
    for wrong in (frozen, image[:, ::2], image.astype(np.float64)):
        with pytest.raises(TypeError, match="paint takes"):
            compiled.paint(wrong, np.zeros((1, 2)), STAMPS.stamps)
    with pytest.raises(TypeError, match="of one shape"):
        compiled.expose(image, image, image[1:], np.zeros((64, 90), np.int8), 0, 0)
    with pytest.raises(TypeError, match="p > 0"):
        compiled.paint(image, np.zeros((1, 2)), np.zeros((0, 0, 5, 5), np.uint8))
    noise = np.zeros((64, 90), np.int8)
    for top, left in ((5, 0), (0, 11), (-1, 0), (0, -1), (2**63 - 1, 0), (0, 2**63 - 1)):
        with pytest.raises(ValueError, match="leaves the noise"):
            compiled.expose(image, image, image, noise, top, left)
    for top, left in ((2**63, 0), (0, -(2**63) - 1)):
        with pytest.raises(OverflowError):
            compiled.expose(image, image, image, noise, top, left)


def test_the_same_seed_draws_the_same_frames() -> None:
    first, second = FrameRenderer(seed=(3, 7)), FrameRenderer(seed=(3, 7))
    np.testing.assert_array_equal(first.raw(PIXELS, 5), second.raw(PIXELS, 5))
    assert (first.raw(PIXELS, 5) != first.raw(PIXELS, 6)).any()
    assert (first.raw(PIXELS, 5) != FrameRenderer(seed=(3, 8)).raw(PIXELS, 5)).any()


def test_raw_frames_have_bright_pins_dark_skin_vignetting_and_noise() -> None:
    light = Lighting(background=60, pin=190, vignetting=0.25, noise=2.0)
    frame = FrameRenderer(lighting=light).raw(PIXELS)
    assert frame.shape == (480, 640)
    assert frame.dtype == np.uint8
    u, v = np.round(PIXELS[0]).astype(int)
    assert frame[v, u] == pytest.approx(190, abs=10)
    assert frame[:20, :20].mean() == pytest.approx(60 * 0.75, abs=2)
    empty = FrameRenderer(lighting=light).raw(np.empty((0, 2)))
    clean = FrameRenderer(lighting=Lighting(60, 190, 0.25, noise=0.0)).raw(np.empty((0, 2)))
    difference = empty.astype(float) - clean
    assert difference.std() == pytest.approx(2.0, rel=0.05)
    assert difference.mean() == pytest.approx(0.0, abs=0.05)


def test_thresholding_a_raw_frame_finds_the_pins_that_the_processed_image_shows() -> None:
    renderer = FrameRenderer()
    left, top, right, bottom = PUBLIC_CROP
    raw = renderer.raw(PIXELS)[top:bottom, left:right]
    processed = renderer.processed(PIXELS)
    assert processed.shape == (440, 445)
    assert set(np.unique(processed)) == {0, 255}
    threshold = cv2.adaptiveThreshold(raw, 255, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, cv2.THRESH_BINARY, 61, -5)
    both = ((threshold > 0) & (processed > 0)).sum() / ((threshold > 0) | (processed > 0)).sum()
    assert both > 0.85
