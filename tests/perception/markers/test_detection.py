from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.helpers.marker_samples import CORNER, REST, SIZE, simulated
from touchcell.perception.errors import ImageError
from touchcell.perception.markers.detection import Discs, detect_markers, lattice, ring_numbers, typical_size
from touchcell.perception.markers.figures import density_change
from touchcell.perception.markers.lattice_fit import fit_lattice
from touchcell.perception.models.marker_architecture import MarkerSize
from touchcell.perception.models.preprocessing import AdaptiveThreshold, Crop, Preprocessing
from touchcell.simulation.render import FrameRenderer

MARKERS = MarkerSize.of_disc(np.pi * 6.2**2)


def errors(discs: Discs, truth: np.ndarray) -> np.ndarray:
    """Return the distance of each disc from its nearest marker."""
    return np.linalg.norm(discs.centres[:, None] - truth[None], axis=2).min(axis=1)


def inside(pixels: np.ndarray, margin: float = 8.0) -> np.ndarray:
    return pixels[((pixels > margin) & (pixels < np.array(SIZE[::-1]) - 1 - margin)).all(axis=1)]


def test_centroids_of_binary_images_are_sub_pixel() -> None:
    sample = simulated(20, seed=1)
    for image, pixels in zip(sample.images, sample.pixels, strict=True):
        discs = detect_markers(image, MARKERS)
        off = errors(discs, pixels)
        assert np.median(off) < 0.1
        # The rest are pairs that overlap a little.
        assert np.mean(off < 0.25) > 0.9


def test_centroids_of_camera_frames_are_sub_pixel() -> None:
    left, top = (int(c) for c in CORNER)
    steps = Preprocessing(
        input_size=(480, 640),
        crop=Crop(left, top, left + SIZE[1], top + SIZE[0]),
        median_px=5,
        threshold=AdaptiveThreshold(block_px=61, offset=-5.0),
        output_size=SIZE,
    )
    frame = FrameRenderer(seed=3).raw(REST + CORNER)
    binary = steps.reduce(frame)
    discs = detect_markers(binary, typical_size(binary))
    assert len(discs) == 331
    assert errors(discs, REST).mean() < 0.1


def test_speckle_halo_and_reflections_change_nothing() -> None:
    rng = np.random.default_rng(0)
    clean = FrameRenderer().processed(REST + CORNER)
    dirty = clean.copy()
    apart = cv2.dilate(clean, np.ones((5, 5), np.uint8)) == 0
    dirty[apart & (rng.random(clean.shape) < 0.02)] = 255
    cv2.rectangle(dirty, (0, 180), (12, 260), 255, cv2.FILLED)
    cv2.rectangle(dirty, (150, 430), (230, 439), 255, cv2.FILLED)
    found = detect_markers(dirty, MARKERS)
    np.testing.assert_array_equal(found.centres, detect_markers(clean, MARKERS).centres)
    assert len(found) == 331


def test_merged_markers_are_left_out() -> None:
    pixels = REST.copy()
    pixels[1] = pixels[0] + [11.0, 0.0]
    discs = detect_markers(FrameRenderer().processed(pixels + CORNER), MARKERS)
    assert len(discs) == 329
    assert errors(discs, np.delete(pixels, [0, 1], axis=0)).max() < 0.5


@pytest.mark.parametrize("grey", [0, 255])
def test_one_colour_holds_no_markers(grey: int) -> None:
    image = np.full(SIZE, grey, np.uint8)
    assert len(detect_markers(image, MARKERS)) == 0
    with pytest.raises(ImageError) as caught:
        typical_size(image)
    assert caught.value.attribute == "content"


def test_noise_holds_no_lattice() -> None:
    noise = (np.random.default_rng(0).random(SIZE) < 0.25).astype(np.uint8) * 255
    assert len(detect_markers(noise, MARKERS)) < 100
    checkerboard = np.indices(SIZE).sum(axis=0) % 4 // 2 * np.uint8(255)
    assert len(detect_markers(checkerboard.astype(np.uint8), MARKERS)) == 0


@pytest.mark.parametrize("image", [np.zeros((3, 4, 3), np.uint8), np.zeros((9, 9)), None])
def test_other_images_are_refused(image: object) -> None:
    with pytest.raises(ImageError):
        detect_markers(image, MARKERS)  # type: ignore[arg-type]


def test_lattice_of_the_tactip() -> None:
    points = lattice(10)
    assert points.shape == (331, 2)
    rings = ring_numbers(10)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), rings, atol=1e-12)
    assert [int((rings == k).sum()) for k in range(11)] == [1] + [6 * k for k in range(1, 11)]


@pytest.mark.parametrize(
    ("turn_deg", "zoom", "shift"), [(0.0, 1.0, (0, 0)), (23.0, 0.9, (10, -8)), (-41.0, 1.04, (3, 2))]
)
def test_lattice_is_fitted_to_an_undeformed_tip(turn_deg: float, zoom: float, shift: tuple[float, float]) -> None:
    turn = np.deg2rad(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    middle = REST.mean(axis=0)
    truth = middle + zoom * (REST - middle) @ rotation.T + shift
    rng = np.random.default_rng(1)
    discs = np.delete(truth, rng.choice(331, 6, replace=False), axis=0)
    discs = np.concatenate([discs + rng.normal(0.0, 0.2, discs.shape), [[2.0, 3.0], [440.0, 430.0]]])
    points, rms = fit_lattice(Discs(discs, np.full(len(discs), 120.0)), 10)
    assert rms < 1.0
    distances = np.linalg.norm(points[:, None] - truth[None], axis=2)
    assert distances.min(axis=1).max() < 2.0
    assert len(set(distances.argmin(axis=1))) == 331


def test_density_rises_where_markers_crowd() -> None:
    middle = REST.mean(axis=0)
    assert np.abs(density_change(REST, REST, SIZE, 18.0)).max() == 0.0
    # Markers right of the centre move away from it: fewer there, and more at the rim.
    from_middle = REST - middle
    near = np.exp(-((np.linalg.norm(from_middle - [60.0, 0.0], axis=1) / 50.0) ** 2))
    change = density_change(REST + 0.5 * near[:, None] * (from_middle - [60.0, 0.0]), REST, SIZE, 18.0)
    v, u = (int(c) for c in (middle[1] / 4, (middle[0] + 60.0) / 4))
    assert change[v, u] < -0.3
    assert change.max() > 0.1
    assert abs(change[v, int((middle[0] - 120.0) / 4)]) < 0.05
    nothing = density_change(REST + 1000.0, REST, SIZE, 18.0)
    assert nothing.min() == -1.0
    assert nothing.max() == 0.0
