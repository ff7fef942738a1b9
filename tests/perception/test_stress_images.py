"""For any frame a camera delivers, preprocessing, network and filter return a valid estimate or a typed error."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.tactile_samples import SIZE, contacts, draw
from tests.perception.models.test_model_file import make_model
from tests.perception.runtime.test_inference import constant_model
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.errors import TouchcellError
from touchcell.geometry import gaussian
from touchcell.geometry.types import ImageArray
from touchcell.perception.errors import ImageError
from touchcell.perception.models.preprocessing import AdaptiveThreshold, Crop, Preprocessing
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.inference import ContactModel
from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter
from touchcell.perception.runtime.pipeline import ContactPipeline

RAW_SIZE = (480, 640)
CHAIN = Preprocessing(
    input_size=RAW_SIZE,
    crop=Crop(105, 25, 535, 455),
    median_px=5,
    threshold=AdaptiveThreshold(block_px=61, offset=-5.0),
    mask_radius_px=214.0,
    output_size=(32, 32),
)
"""All steps of a preprocessing."""

FILTERS = {
    "still": lambda: PoseFilter(isotropic_noise(1e-3, 0.01)),
    "moving": lambda: MovingSurfaceFilter(*[isotropic_noise(1e-2, 0.1)] * 3),
}


def ill_frames(size: tuple[int, int]) -> dict[str, ImageArray]:
    """Frames of a failing camera, cable or lamp."""
    rng = np.random.default_rng(0)
    good, other = (draw(contact, size) for contact in contacts(2, seed=3))
    height = size[0]
    torn, half, shifted = good.copy(), good.copy(), np.roll(good, size[1] // 3, axis=1)
    torn[height // 2 :] = other[height // 2 :]
    half[height // 2 :] = 0
    stripes = good.copy()
    stripes[::2] = 255
    return {
        "black": np.zeros(size, np.uint8),
        "white": np.full(size, 255, np.uint8),
        "grey": np.full(size, 128, np.uint8),
        "saturated": np.where(good > 10, 255, 0).astype(np.uint8),
        "torn": torn,
        "half": half,
        "shifted": shifted,
        "inverted": np.asarray(255 - good, np.uint8),
        "stripes": stripes,
        "noise": rng.integers(0, 256, size, dtype=np.uint8),
        "salt": np.where(rng.random(size) < 0.01, 255, 0).astype(np.uint8),
    }


class Playback:
    """A camera with these frames, one every 30 ms."""

    def __init__(self, images: list[ImageArray]) -> None:
        self._images = images
        self.seq = 0

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        return Stamped(Frame(self._images[self.seq]), self.seq * 30_000_000, self.seq)

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        raise AssertionError("the pipeline never waits for a frame")


@pytest.mark.parametrize("name", sorted(ill_frames(SIZE)))
def test_preprocessing_accepts_every_frame(name: str) -> None:
    reduced = CHAIN.reduce(ill_frames(RAW_SIZE)[name])
    assert reduced.shape == (32, 32)
    assert reduced.dtype == np.uint8
    applied = CHAIN.apply(ill_frames(RAW_SIZE)[name])
    assert 0.0 <= applied.min() <= applied.max() <= 1.0


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("weights", [0.1, 1.0, 1e3])
def test_estimates_stay_valid_through_bad_frames(kind: str, weights: float) -> None:
    """Bad frames between good ones, with a network whose outputs are at their bounds for the larger weights."""
    model = make_model(reference=False)
    for tensor in model.tensors.values():
        tensor *= np.float32(weights)
    good = [draw(contact) for contact in contacts(3, seed=1)]
    images = [image for bad in ill_frames(SIZE).values() for image in (*good, bad)]
    camera = Playback(images)
    pipeline = ContactPipeline(camera, ContactModel(model), pose_filter=FILTERS[kind]())  # type: ignore[operator]
    for seq in range(len(images)):
        camera.seq = seq
        t_ns = seq * 30_000_000
        pipeline.record_pose(t_ns, np.eye(4))
        estimate = pipeline.update(t_ns + 5_000_000)
        assert estimate is not None
        assert estimate.belief is not None
        assert np.isfinite(estimate.belief.mean).all()
        np.testing.assert_array_equal(estimate.belief.covariance, estimate.belief.covariance.T)
        np.linalg.cholesky(estimate.belief.covariance)
        # Outputs end at three half-ranges of the labels; the largest range of a translation is 6 mm.
        assert np.abs(estimate.belief.mean[:3, 3]).max() < 0.05
        if estimate.nis is not None:
            assert 0.0 <= estimate.nis < np.inf


def test_the_contact_gate_accepts_every_frame() -> None:
    frames = ill_frames((32, 32))
    gate = ContactGate(frames["black"])
    for image in frames.values():
        gate.update(image)
        assert 0.0 <= gate.score <= 1.0


@pytest.mark.parametrize(
    "image",
    [
        np.full(SIZE, np.nan),
        np.full(SIZE, np.inf, np.float32),
        np.zeros((SIZE[0] // 2, SIZE[1]), np.uint8),
        np.zeros((0, 0), np.uint8),
        np.zeros((*SIZE, 3), np.uint8),
        np.zeros((*SIZE, 1, 1), np.uint8),
        np.zeros(SIZE, np.uint16),
        np.zeros(SIZE, bool),
        None,
    ],
    ids=["nan", "inf", "half", "empty", "colour", "four axes", "uint16", "bool", "none"],
)
def test_other_images_are_refused(image: object) -> None:
    with pytest.raises(ImageError):
        ContactModel(make_model()).predict(image)  # type: ignore[arg-type]


@pytest.mark.parametrize("output", [1e30, 3e38, np.inf, -np.inf, np.nan])
def test_unbounded_network_output_is_a_typed_error(output: float) -> None:
    """A plain network's outputs are unbounded.

    An invalid contact never reaches the filter, whose state is unchanged.
    """
    image = draw(contacts(1, seed=0)[0])
    pose_filter = PoseFilter(isotropic_noise(1e-3, 0.01))
    good, wild = ContactModel(constant_model("cnn", [0.0] * 6)), ContactModel(constant_model("cnn", [output] * 6))
    camera = Playback([image, image])
    pipeline = ContactPipeline(camera, good, pose_filter=pose_filter)
    pipeline.update(0)
    before = pose_filter.state
    camera.seq = 1
    broken = ContactPipeline(camera, wild, pose_filter=pose_filter)
    try:
        estimate = broken.update(30_000_000)
    except TouchcellError:
        assert pose_filter.state is before
    else:
        assert estimate is not None
        assert estimate.belief is not None
        assert not estimate.in_range
        assert np.isfinite(estimate.belief.mean).all()


def test_covariances_of_a_density_network_are_valid_for_a_filter() -> None:
    """Both bounds of the inverse standard deviations give covariances that a filter accepts."""
    image = draw(contacts(1, seed=0)[0])
    beliefs = []
    for log_precision in (-1e6, 0.0, 1e6):
        prediction = ContactModel(constant_model("gdn", [0.0] * 6 + [log_precision] * 6)).predict(image)
        assert (prediction.sigma > 0.0).all()
        beliefs.append(gaussian.from_exponential(prediction.xi, prediction.covariance))
    for prior in beliefs:
        for observation in beliefs:
            fused, record = gaussian.fuse(prior, observation)
            np.linalg.cholesky(fused.covariance)
            assert record.nis == pytest.approx(0.0, abs=1e-9)
