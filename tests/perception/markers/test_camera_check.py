from __future__ import annotations

import numpy as np
import pytest

from touchcell.geometry.types import Array
from touchcell.perception.markers.camera_check import CameraCheck, TearCheck, learn_check, strength_rows
from touchcell.perception.markers.detection import lattice
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.markers.transfer import lattice_symmetries, symmetric_fields

RINGS = 5
SPACING_PX = 20.0


def _sensor(seed: int, pin_px: float) -> tuple[DisplacementModel, Array]:
    """Return the displacement model and 400 contacts of a tip whose rim moves little, with irregular pins."""
    rng = np.random.default_rng(seed)
    reference = SPACING_PX * lattice(RINGS) + 200.0
    place = (reference - 200.0) / (RINGS * SPACING_PX)
    inner = 1.0 - 0.6 * (place**2).sum(axis=1, keepdims=True)
    shapes = [
        np.concatenate([np.ones((len(place), 1)), np.zeros((len(place), 1))], axis=1) * inner,
        np.concatenate([np.zeros((len(place), 1)), np.ones((len(place), 1))], axis=1) * inner,
        place * inner,
        place * inner**2,
        place[:, ::-1] * [-1, 1] * inner,
        place * place[:, :1],
        place * place[:, 1:],
        place[:, ::-1] * inner**2,
    ]
    strengths = np.array([8.0, 8.0, 6.0, 4.0, 4.0, 3.0, 3.0, 2.0])
    pins = rng.normal(0.0, pin_px, reference.size)
    contacts = np.einsum("nk,kj->nj", strengths * rng.normal(0.0, 1.0, (400, 8)), np.stack([s.ravel() for s in shapes]))
    displacements = contacts + pins + rng.normal(0.0, 0.2, contacts.shape)
    seen = np.ones((400, len(reference)), bool)
    return DisplacementModel.fit(reference, displacements.reshape(400, -1, 2), seen, 8), displacements


def _check(model: DisplacementModel, displacements: Array) -> CameraCheck:
    spec, tensors = learn_check(model, RINGS, displacements)
    mean = tensors["camera.mean"].astype(np.float64)
    tear = TearCheck(tensors["camera.basis"], mean, strength_rows(model), spec)
    return CameraCheck(tensors["camera.functionals"], mean, SPACING_PX, tear)


def _everything(displacements: Array) -> np.ndarray:
    return np.ones(displacements.shape[-1] // 2, bool)


@pytest.fixture(scope="module")
def sensor() -> tuple[DisplacementModel, Array]:
    return _sensor(0, pin_px=0.8)


def test_contacts_of_the_models_own_camera_are_accepted(sensor: tuple[DisplacementModel, Array]) -> None:
    model, displacements = sensor
    check = _check(model, displacements[:300])
    assert not any(check(each, _everything(each)).refusal for each in displacements[300:])


@pytest.mark.parametrize(
    ("shift_px", "zoom", "turn_deg", "what"),
    [((10.0, 0.0), 0.0, 0.0, "shifted"), ((0.0, 0.0), 0.05, 0.0, "zoomed"), ((0.0, 0.0), 0.0, -5.0, "turned")],
)
def test_moved_camera_is_refused_from_a_single_contact_and_measured(
    sensor: tuple[DisplacementModel, Array], shift_px: tuple[float, float], zoom: float, turn_deg: float, what: str
) -> None:
    model, displacements = sensor
    check = _check(model, displacements[:300])
    place = model.reference - model.reference.mean(axis=0)
    turned = np.radians(turn_deg) * np.column_stack([-place[:, 1], place[:, 0]])
    change = (np.array(shift_px) + zoom * place + turned).ravel()
    for each in displacements[300:]:
        found = check(each + change, _everything(each))
        assert what in found.refusal
        assert np.allclose(found.shift_px, shift_px, atol=1.5)
        assert found.zoom == pytest.approx(zoom, abs=0.015)
        assert np.degrees(found.turn_rad) == pytest.approx(turn_deg, abs=0.8)


def test_turned_and_mirrored_cameras_are_named_where_pins_are_irregular(
    sensor: tuple[DisplacementModel, Array],
) -> None:
    model, displacements = sensor
    check = _check(model, displacements[:300])
    assert check.knows_turns
    symmetries = lattice_symmetries(RINGS)
    for number, copies in enumerate(symmetric_fields(displacements[300:330], model.reference, symmetries)):
        found = [check(each.astype(np.float64), _everything(each)) for each in copies]
        assert all(each.symmetry == number for each in found)
        assert all(("mirrored" in each.refusal) == (number >= 6) for each in found)
        assert number != 3 or all("about 180 deg" in each.refusal for each in found)


def test_perfect_lattice_accepts_its_symmetric_copies() -> None:
    model, displacements = _sensor(1, pin_px=0.0)
    check = _check(model, displacements[:300])
    assert not check.knows_turns
    upside_down = symmetric_fields(displacements[300:], model.reference, lattice_symmetries(RINGS))[3]
    assert not any(check(each.astype(np.float64), _everything(each)).symmetry for each in upside_down)


def test_halves_of_two_contacts_are_torn(sensor: tuple[DisplacementModel, Array]) -> None:
    model, displacements = sensor
    check = _check(model, displacements[:300])
    left = np.repeat(model.reference[:, 0] < 200.0, 2)
    torn = np.where(left, displacements[300:350], displacements[350:])
    assert np.mean([bool(check(each, _everything(each)).refusal) for each in torn]) > 0.95


def test_missing_pins_are_no_tear(sensor: tuple[DisplacementModel, Array]) -> None:
    model, displacements = sensor
    check = _check(model, displacements[:300])
    rng = np.random.default_rng(2)
    for each in displacements[300:]:
        seen = rng.random(len(model.reference)) > 0.2
        within = model.mean + (each - model.mean) @ model.basis.T @ model.basis
        filled = np.where(np.repeat(seen, 2), each, within)
        assert not check(filled, seen).refusal


@pytest.mark.parametrize("taught", [24, 60])
def test_a_check_of_few_contacts_refuses_hardly_any_of_the_sensors_own(taught: int) -> None:
    """It knows few components, and takes the others for a camera that is turned, mirrored or moved."""
    model, displacements = _sensor(3, pin_px=0.05)
    rough = displacements + np.random.default_rng(3).normal(0.0, 2.0, (400, 1)) * displacements[::-1] * 0.3
    check = _check(model, rough[:taught])
    refused = [check(each, _everything(each)).refusal for each in rough[taught:]]
    assert np.mean([bool(each) and "tip" not in each for each in refused]) < 0.05
