from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.helpers.marker_samples import REST, SIZE, Simulated, simulated
from tests.perception.markers.test_detection import MARKERS, inside

pytest.importorskip("torch")

from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import Discs, detect_markers
from touchcell.perception.markers.lattice_fit import fit_lattice
from touchcell.perception.markers.matching import DisplacementModel, MarkerField, MarkerMatcher
from touchcell.perception.networks.marker_learning import Learned, learn_markers


@pytest.fixture(scope="module")
def learned() -> Learned:
    """A matcher learned from images only, of simulated contacts."""
    frames = [detect_markers(image, MARKERS) for image in simulated(200, seed=11).images]
    reference, _ = fit_lattice(Discs(REST, np.full(331, 120.0)), 10)
    return learn_markers(frames, SIZE, modes=20, reference=reference, rounds=1, guess_steps=60)


@pytest.fixture(scope="module")
def sample() -> Simulated:
    return simulated(150, seed=13)


def identity_of(learned: Learned) -> np.ndarray:
    """Return the simulated marker of each marker of the learned lattice, up to the six equal rotations."""
    distances = np.linalg.norm(learned.matcher.model.reference[:, None] - REST[None], axis=2)
    identity = distances.argmin(axis=1)
    assert len(set(identity)) == 331
    return identity


def correct_fraction(field: MarkerField, truth: np.ndarray) -> float:
    """Return the fraction of the seen markers whose disc is their own."""
    off = np.linalg.norm(field.positions - truth, axis=1)[field.seen]
    return float((off < 2.0).mean()) if len(off) else 0.0


def test_cold_start_is_right_over_the_whole_range(learned: Learned, sample: Simulated) -> None:
    identity = identity_of(learned)
    right, trusted = [], []
    for image, pixels in zip(sample.images, sample.pixels, strict=True):
        field = learned.matcher.match(detect_markers(image, MARKERS))
        right.append(correct_fraction(field, pixels[identity]))
        trusted.append(field.valid)
        if field.valid:
            assert field.seen.sum() >= 0.9 * len(inside(pixels))
    well = np.array(right) > 0.97
    assert well.mean() >= 0.99
    assert np.mean(well[trusted]) >= 0.99
    # Wrong matches are marked as invalid.
    assert np.mean(trusted) >= 0.97


def test_seen_markers_are_sub_pixel_and_hidden_ones_near(learned: Learned, sample: Simulated) -> None:
    identity = identity_of(learned)
    hidden_errors = []
    for image, pixels in zip(sample.images[:60], sample.pixels[:60], strict=True):
        discs = detect_markers(image, MARKERS)
        keep = np.random.default_rng(0).random(len(discs)) > 0.04
        field = learned.matcher.match(Discs(discs.centres[keep], discs.areas[keep]))
        if not field.valid:
            continue
        truth = pixels[identity]
        off = np.linalg.norm(field.positions - truth, axis=1)
        visible = ((truth > 8) & (truth < np.array(SIZE[::-1]) - 9)).all(axis=1)
        assert np.median(off[field.seen & visible]) < 0.1
        hidden_errors.append(off[~field.seen & visible])
        np.testing.assert_allclose(field.displacements, field.positions - learned.matcher.model.reference)
    errors = np.concatenate(hidden_errors)
    assert len(errors) > 100
    assert np.median(errors) < 1.5


def test_tracking_and_a_cold_start_give_the_same(learned: Learned) -> None:
    start, end = (REST, simulated(1, seed=17, depth_mm=(3.0, 3.1)).pixels[0])
    previous = None
    identity = identity_of(learned)
    for share in np.linspace(0.0, 1.0, 12):
        places = start + share * (end - start)
        discs = Discs(places, np.full(331, 120.0))
        cold = learned.matcher.match(discs)
        tracked = learned.matcher.match(discs, previous)
        np.testing.assert_array_equal(tracked.seen, cold.seen)
        np.testing.assert_allclose(tracked.positions, cold.positions, atol=0.2)
        np.testing.assert_allclose(tracked.positions[tracked.seen], places[identity][tracked.seen], atol=1e-9)
        assert tracked.valid
        previous = tracked


def test_a_failed_guess_is_not_used(learned: Learned, sample: Simulated) -> None:
    """With a blind first guess, the match starts from the learned contact with the most similar discs."""
    model = learned.matcher.model
    nothing = np.zeros_like(learned.guess.bias)
    nothing[:2] = 3.0
    blind = dataclasses.replace(learned.guess, weight=np.zeros_like(learned.guess.weight), bias=nothing)
    identity = identity_of(learned)
    truth = sample.pixels[:20][:, identity]
    bank = ((truth - model.reference).reshape(20, -1) - model.mean) @ model.basis.T
    helped = MarkerMatcher(model, blind, SIZE, bank=bank)
    alone = MarkerMatcher(model, blind, SIZE, bank=np.tile(nothing, (3, 1)) * model.sd)
    for places in truth:
        discs = Discs(places, np.full(331, 120.0))
        field = helped.match(discs)
        assert field.valid
        np.testing.assert_allclose(field.positions[field.seen], places[field.seen], atol=1e-9)
        lost = alone.match(discs)
        assert correct_fraction(lost, places) > 0.97 or not lost.valid


def test_a_fifth_of_the_pins_may_have_broken_off(learned: Learned, sample: Simulated) -> None:
    identity = identity_of(learned)
    broken = np.random.default_rng(2).permutation(331)[:66]
    valid, right = [], []
    for pixels in sample.pixels[:40]:
        places = inside(np.delete(pixels, broken, axis=0))
        field = learned.matcher.match(Discs(places, np.full(len(places), 120.0)))
        valid.append(field.valid)
        right.append(correct_fraction(field, pixels[identity]) > 0.97)
    assert np.mean(valid) >= 0.9
    assert np.mean(np.array(right)[valid]) >= 0.95


def test_a_jump_between_frames_is_survived(learned: Learned, sample: Simulated) -> None:
    identity = identity_of(learned)
    previous, right = None, []
    for image, pixels in zip(sample.images[:80], sample.pixels[:80], strict=True):
        previous = learned.matcher.match(detect_markers(image, MARKERS), previous)
        right.append(correct_fraction(previous, pixels[identity]) > 0.97 or not previous.valid)
    assert np.mean(right) >= 0.98


@pytest.mark.parametrize("n", [0, 5, 331, 2000])
def test_discs_that_are_not_a_lattice_are_invalid(learned: Learned, n: int) -> None:
    places = np.random.default_rng(n).uniform(0.0, 440.0, (n, 2))
    field = learned.matcher.match(Discs(places, np.full(n, 120.0)))
    assert not field.valid
    assert field.positions.shape == (331, 2)
    assert np.isfinite(field.positions).all()


def test_images_without_a_lattice_raise() -> None:
    rng = np.random.default_rng(0)
    frames = [Discs(rng.uniform(0.0, 440.0, (331, 2)), np.full(331, 120.0)) for _ in range(10)]
    with pytest.raises(TrainingError, match="lattice"):
        learn_markers(frames, SIZE)
    with pytest.raises(TrainingError, match="lattice"):
        learn_markers([Discs(np.empty((0, 2)), np.empty(0))] * 10, SIZE)


def test_too_few_images_are_said_to_be_too_few_before_they_are_matched() -> None:
    place = np.zeros((331, 2))
    with pytest.raises(TrainingError, match="45 images are too few") as refused:
        learn_markers([Discs(place, np.full(331, 120.0))] * 45, SIZE, reference=place)
    assert "48 are needed" in refused.value.hint


def test_principal_components_fill_unseen_markers() -> None:
    rng = np.random.default_rng(3)
    reference = rng.uniform(0.0, 100.0, (20, 2))
    basis = np.linalg.qr(rng.normal(size=(40, 3)))[0].T
    truth = (rng.normal(0.0, [30.0, 10.0, 5.0], (200, 3)) @ basis + 2.0).reshape(200, 20, 2)
    seen = rng.random((200, 20)) > 0.1
    model = DisplacementModel.fit(reference, np.where(seen[..., None], truth, 2.0), seen, 3)
    np.testing.assert_allclose(model.basis @ model.basis.T, np.eye(3), atol=1e-9)
    # The components span the true ones, though a tenth of the entries were missing.
    assert np.linalg.norm(basis - basis @ model.basis.T @ model.basis) < 0.1
