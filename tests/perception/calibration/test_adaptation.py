from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.perception.models.test_model_file import make_model

pytest.importorskip("torch")

import torch

from benchmarks.adapt import _drawn, predicted, second_sensor
from tests.helpers.marker_samples import SIZE, write_split
from touchcell.cell.cli.calibrate_sim import calibrate_sim
from touchcell.cell.cli.train_sim import Imagined, _discs
from touchcell.drivers.replay.dataset import PUBLIC_CROP, REST_IMAGE, read_image
from touchcell.geometry import se3
from touchcell.perception.calibration import adaptation
from touchcell.perception.calibration.adaptation import (
    Adapted,
    AdaptSettings,
    _fit,
    adapt,
    adapt_to,
    align_camera,
    missing_contacts,
)
from touchcell.perception.calibration.transfer_fit import Convention
from touchcell.perception.errors import ModelError, TrainingError
from touchcell.perception.markers.detection import Discs
from touchcell.perception.markers.estimator import MarkerEstimator, matcher_of
from touchcell.perception.markers.layers import layers_of, outputs_of
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.markers.transfer import lattice_symmetries, ring_modes, ring_weights, symmetric_fields
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact
from touchcell.perception.models.marker_architecture import MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Header, Labels, Model, load_model, save_model
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.contact_network import Alignment
from touchcell.perception.networks.displacement_network import DisplacementNetwork
from touchcell.perception.networks.marker_learning import train_guess
from touchcell.perception.networks.marker_training import LabelledDiscs
from touchcell.perception.runtime.calibrated_estimator import turned
from touchcell.perception.runtime.estimators import load_estimator
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import load_tip

TIP, RIG = TipParameters(), MountModel()
SETTINGS = AdaptSettings(steps=40)
SIZE_OF_MARKERS = MarkerSize.of_disc(np.pi * TIP.disc_radius_px**2)


@pytest.fixture(scope="module")
def model() -> Model:
    """A small marker model of the default sensor, whose matcher was given the markers instead of learning them."""
    tip = Tip(TIP)
    corner = np.array(PUBLIC_CROP[:2], dtype=np.float64)
    reference = tip.project(tip.rest_positions) - corner
    rng = np.random.default_rng(0)
    from touchcell.perception.contact_poses import random_poses

    poses = random_poses(500, rng, (0.2, 6.2))
    displacements = tip.pixels(RIG.contact(poses)) - corner - reference
    displacements += rng.normal(0.0, 0.15, displacements.shape)
    moves = DisplacementModel.fit(reference, displacements, np.ones((500, 331), bool), 16)
    coefficients = (displacements.reshape(500, -1) - moves.mean) @ moves.basis.T
    guess = train_guess(moves, coefficients, np.ones((500, 331), bool), noise_px=1.0, scatter=0.1, steps=30, seed=0)
    architecture = MarkerArchitecture(
        input_size=SIZE,
        size=SIZE_OF_MARKERS,
        modes=16,
        bank=len(coefficients),
        guess_low_px=(float(guess.low[0]), float(guess.low[1])),
        guess_cell_px=guess.cell_px,
        least_score=0.9,
        most_rms_px=4.0,
        hidden=(96, 48),
        networks=1,
    )
    xi = se3.log(se3.inverse(poses))
    contacts = se3.to_euler_mm_deg(poses)
    labels = Labels.of_contacts(tuple(contacts.min(axis=0).tolist()), tuple(contacts.max(axis=0).tolist()))
    tensors = {
        "lattice": reference,
        "displacement.mean": moves.mean,
        "displacement.basis": moves.basis,
        "displacement.sd": moves.sd,
        "bank": coefficients,
        "guess.hidden.weight": np.ascontiguousarray(guess.hidden_weight.T),
        "guess.hidden.bias": guess.hidden_bias,
        "guess.output.weight": guess.weight,
        "guess.output.bias": guess.bias,
        "guess.sd": guess.sd,
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = DisplacementNetwork(moves, architecture.hidden, architecture.networks)
        settings = AdaptSettings(steps=500, learning_rate=3e-3)
        _fit(
            network,
            displacements.reshape(500, -1).astype(np.float32),
            labels.targets(xi),
            moves,
            Alignment(labels),
            settings,
        )
    tensors |= network.folded()
    header = Header(
        touchcell_version="0.1.0",
        architecture=architecture,
        preprocessing=Preprocessing(input_size=SIZE, output_size=SIZE),
        labels=labels,
        sigma_scale=(1.0,) * 6,
        training_data="00",
    )
    return Model(header, {name: np.ascontiguousarray(each, np.float32) for name, each in tensors.items()})


def _adapted(model: Model, few: LabelledDiscs) -> Adapted:
    return adapt_to(model, few, preprocessing=model.header.preprocessing, size=SIZE_OF_MARKERS, settings=SETTINGS)


def _relabelled(contacts: LabelledDiscs, sign: float, mirrored: bool, turn_deg: float) -> LabelledDiscs:
    """Return the same images with labels about other axes, in a mirror, or with the shear's sign reversed."""
    turn = np.exp(1j * np.radians(turn_deg))
    mm_deg = contact_from_xi(contacts.xi)
    for first, factor in ((0, sign), (3, 1.0)):
        vector = mm_deg[:, first] + 1j * mm_deg[:, first + 1]
        vector = factor * turn * (vector.conj() * (1.0 if first == 0 else -1.0) if mirrored else vector)
        mm_deg[:, first], mm_deg[:, first + 1] = vector.real, vector.imag
    mm_deg[:, 5] *= sign * (-1.0 if mirrored else 1.0)
    return LabelledDiscs(contacts.frames, xi_from_contact(mm_deg))


def _mae(model: Model, contacts: LabelledDiscs) -> np.ndarray:
    return np.abs(predicted(model, contacts).errors).mean(axis=0)


@pytest.fixture(scope="module")
def other_sensor(model: Model) -> tuple[LabelledDiscs, LabelledDiscs]:
    """Contacts of another simulated sensor, to adapt with and to measure on."""
    tip, rig = second_sensor(TIP, RIG)
    return _drawn(tip, rig, 30, 7, model), _drawn(tip, rig, 60, 8, model)


@pytest.mark.parametrize(
    ("sign", "mirrored", "turn_deg"), [(1.0, False, 0.0), (-1.0, False, 130.0), (1.0, True, 0.0), (-1.0, True, -75.0)]
)
def test_thirty_images_adapt_to_another_sensor_whatever_the_convention_of_its_labels(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs], sign: float, mirrored: bool, turn_deg: float
) -> None:
    few, held_out = (_relabelled(each, sign, mirrored, turn_deg) for each in other_sensor)
    adapted = _adapted(model, few)
    assert adapted.method == "transfer"
    assert adapted.convention.mirrored == mirrored
    assert adapted.convention.shear_reversed == (sign < 0.0)
    guess = np.abs(np.median(contact_from_xi(few.xi), axis=0) - contact_from_xi(held_out.xi)).mean(axis=0)
    error = _mae(adapted.model, held_out)
    assert (error[[2, 3, 4]] < 0.25 * guess[[2, 3, 4]]).all()
    assert (error[[0, 1]] < 0.7 * guess[[0, 1]]).all()


def test_adapted_model_is_loaded_from_its_file_and_knows_that_it_was_adapted(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs], tmp_path: Path
) -> None:
    few, held_out = other_sensor
    adapted = _adapted(model, few)
    save_model(adapted.model, tmp_path / "adapted.safetensors")
    estimator = load_estimator(tmp_path / "adapted.safetensors")
    assert estimator.header.training["adapted_images"] == 30
    assert estimator.header.transfer == adapted.model.header.transfer
    loaded = load_model(tmp_path / "adapted.safetensors")
    np.testing.assert_allclose(_mae(loaded, held_out), _mae(adapted.model, held_out))
    with pytest.raises(ModelError, match="adapted already"):
        adapt(tmp_path / "adapted.safetensors", tmp_path, tmp_path / "again.safetensors")


def test_the_image_out_of_contact_is_kept_for_the_contact_gate(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_split(tmp_path, "train", 2, 1)
    image = read_image(tmp_path / "train" / "processed_images" / "image_1.png")
    cv2.imwrite(str(tmp_path / REST_IMAGE), image)
    save_model(model, tmp_path / "old.safetensors")
    same_camera = CameraChange(zoom=1.0, turn_deg=0.0, centre_px=(0.0, 0.0), shift_px=(0.0, 0.0), frames=1, rms_px=0.1)
    mapped = dataclasses.replace(model, header=model.header.model_copy(update={"camera": same_camera}), reference=None)
    result = Adapted(mapped, "transfer", {}, Convention(False, 0.0, 0.0, 1.0, 1.0), 2, 2, (), (), ())
    monkeypatch.setattr(adaptation, "adapt_to", lambda *args, **named: result)
    adapt(tmp_path / "old.safetensors", tmp_path, tmp_path / "new.safetensors")
    np.testing.assert_array_equal(load_model(tmp_path / "new.safetensors").reference, image)


def test_sigma_covers_most_left_out_contacts_of_the_other_sensor(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs]
) -> None:
    few, held_out = other_sensor
    coverage = predicted(_adapted(model, few).model, held_out).coverage(0.95)
    assert min(coverage.values()) > 0.75


def _wrong(contacts: np.ndarray, what: str) -> np.ndarray:
    """Return labels (n, 6) as somebody might have got them wrong."""
    other = np.random.default_rng(1).permutation(len(contacts))
    wrong = contacts.copy()
    if what == "other images":
        wrong = contacts[other]
    elif what == "shear of other images":
        wrong[:, :2] = contacts[other, :2]
    elif what == "depth of other images":
        wrong[:, 2] = contacts[other, 2]
    elif what == "radians":
        wrong[:, 3:] = np.radians(contacts[:, 3:])
    elif what == "metres":
        wrong[:, :3] *= 1e-3
    elif what == "tilt and torsion swapped":
        wrong[:, [3, 5]] = contacts[:, [5, 3]]
    elif what == "x and depth swapped":
        wrong[:, [0, 2]] = contacts[:, [2, 0]]
    elif what == "depth of the other sign":
        wrong[:, 2] *= -1.0
    return wrong


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("other images", "labels' depth and tilt"),
        ("shear of other images", "labels' shear cannot be"),
        ("depth of other images", "labels' depth cannot be"),
        ("radians", "tilt in degrees"),
        ("metres", "depth in mm"),
        ("tilt and torsion swapped", "labels' tilt"),
        ("x and depth swapped", "labels' depth"),
        ("depth of the other sign", "grows into the surface"),
    ],
)
def test_labels_that_cannot_be_of_these_images_are_refused_whatever_is_wrong_with_them(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs], what: str, says: str
) -> None:
    few, _ = other_sensor
    wrong = dataclasses.replace(few, xi=xi_from_contact(_wrong(contact_from_xi(few.xi), what)))
    with pytest.raises(TrainingError) as caught:
        _adapted(model, wrong)
    assert says in str(caught.value)


def test_single_label_far_from_all_others_is_named(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs]
) -> None:
    few, _ = other_sensor
    contacts = contact_from_xi(few.xi)
    contacts[7, 2] = 60.0
    with pytest.raises(TrainingError, match=r"^image 7: z_mm of 60 is far from all others"):
        _adapted(model, dataclasses.replace(few, xi=xi_from_contact(contacts)))


def test_candidates_that_are_hardly_better_than_the_mean_are_refused(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("touchcell.perception.calibration.adaptation.refuse_unlike", lambda *_: None)
    few, _ = other_sensor
    shuffled = dataclasses.replace(few, xi=few.xi[np.random.default_rng(1).permutation(len(few.xi))])
    with pytest.raises(TrainingError, match="better on left-out contacts"):
        _adapted(model, shuffled)


def test_image_with_the_label_of_another_is_named(
    model: Model, other_sensor: tuple[LabelledDiscs, LabelledDiscs]
) -> None:
    few, _ = other_sensor
    assert not {"image 3", "image 26"} & set(_adapted(model, few).doubtful)
    xi = few.xi.copy()
    xi[[3, 26]] = few.xi[[26, 3]]
    found = adapt_to(
        model,
        dataclasses.replace(few, xi=xi),
        preprocessing=model.header.preprocessing,
        size=SIZE_OF_MARKERS,
        settings=SETTINGS,
        names=[f"image_{i}.png" for i in range(len(xi))],
    )
    assert {"image_3.png", "image_26.png"} & set(found.doubtful)
    assert len(found.doubtful) <= 6


def test_depths_and_directions_without_contacts_are_named() -> None:
    rng = np.random.default_rng(0)
    contacts = rng.uniform(-1.0, 1.0, (200, 6))
    assert missing_contacts(contacts) == ()
    contacts[:, 2] = np.where(contacts[:, 2] > 0, contacts[:, 2] + 2.0, contacts[:, 2])
    contacts[:, 0] = np.abs(contacts[:, 0])
    found = missing_contacts(contacts)
    assert found[0].startswith("depths between -0.0 and 2.0 mm")
    assert "shear towards 90 to 135 deg" in found
    assert not any(each.startswith("tilt") for each in found)


def test_symmetric_copies_are_the_lattice_turned_and_reflected() -> None:
    tip = Tip(TIP)
    reference = tip.project(tip.rest_positions)
    displacements = np.random.default_rng(0).normal(0.0, 1.0, (2, 662))
    symmetries = lattice_symmetries(10)
    copies = symmetric_fields(displacements, reference, symmetries)
    np.testing.assert_allclose(copies[0], displacements, atol=1e-5)
    assert all(sorted(each.to) == list(range(331)) for each in symmetries)
    once = symmetric_fields(copies[1].astype(float), reference, [symmetries[5]])[0]
    np.testing.assert_allclose(once, displacements, atol=1e-4)
    twice = symmetric_fields(copies[6].astype(float), reference, [symmetries[6]])[0]
    np.testing.assert_allclose(twice, displacements, atol=1e-4)


def test_what_rings_do_turns_with_the_markers_or_stays_and_is_reflected_with_them() -> None:
    tip = Tip(TIP)
    reference = tip.project(tip.rest_positions)
    displacements = np.random.default_rng(0).normal(0.0, 1.0, (3, 662))
    symmetries = lattice_symmetries(10)
    copies = symmetric_fields(displacements, reference, [symmetries[0], symmetries[1], symmetries[6]])
    plain, turned_, mirrored = (ring_modes(each.astype(float), ring_weights(reference)) for each in copies)
    assert plain.shape == (3, 5, 3)
    np.testing.assert_allclose(turned_[:, :, [0, 2]], np.exp(1j * np.pi / 3) * plain[:, :, [0, 2]], atol=1e-5)
    np.testing.assert_allclose(turned_[:, :, 1], plain[:, :, 1], atol=1e-5)
    np.testing.assert_allclose(mirrored[:, :, 1], plain[:, :, 1].conj(), atol=1e-5)
    axis = mirrored[:, :, [0, 2]] / plain[:, :, [0, 2]].conj()
    np.testing.assert_allclose(axis, np.broadcast_to(axis[0, 0, 0], axis.shape), atol=1e-3)


def test_turned_predictions_are_about_turned_axes() -> None:
    xi = np.array([1e-3, -2e-3, -4e-3, 0.2, -0.3, 0.05])
    root = np.random.default_rng(0).normal(size=(6, 6))
    found = turned(Prediction(xi, root @ root.T, in_range=True), 40.0)
    Z = se3.from_euler_mm_deg([0, 0, 0, 0, 0, 40.0])
    np.testing.assert_allclose(se3.exp(found.xi), Z @ se3.exp(xi) @ se3.inverse(Z), atol=1e-12)
    np.testing.assert_allclose(turned(found, -40.0).covariance, root @ root.T)


def test_folded_layers_compute_the_same_as_the_model_file(model: Model) -> None:
    architecture = model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    frames = _drawn(TIP, RIG, 5, 9, model).frames
    fields = [matcher_of(model, architecture).match(each) for each in frames]
    mean, _ = outputs_of(
        layers_of(model),
        np.stack([each.displacements.ravel() for each in fields]).astype(np.float32),
        model.header.labels,
    )
    estimator = MarkerEstimator(model)
    for field, expected in zip(fields, mean, strict=True):
        np.testing.assert_allclose(estimator.infer(field)[0], expected, atol=1e-3)


def test_what_cannot_be_adapted_is_refused(model: Model, tmp_path: Path) -> None:
    save_model(make_model(), tmp_path / "gdn.safetensors")
    with pytest.raises(ModelError, match="only marker estimators"):
        adapt(tmp_path / "gdn.safetensors", tmp_path, tmp_path / "out.safetensors")
    few = _drawn(TIP, RIG, 20, 3, model)
    shuffled = [
        Discs(np.random.default_rng(i).uniform(20, 420, (331, 2)), each.areas) for i, each in enumerate(few.frames)
    ]
    with pytest.raises(TrainingError):
        align_camera(model, dataclasses.replace(few, frames=shuffled))
    with pytest.raises(TrainingError, match="are needed"):
        _adapted(model, LabelledDiscs(few.frames[:6], few.xi[:6]))


def test_samples_of_a_real_sensor_are_labelled_with_the_command() -> None:
    imagined = Imagined(load_tip("franka_tactip_1"), processed=True)
    made = _discs(imagined, 40, 3, matched=True)
    contacts = se3.to_euler_mm_deg(se3.inverse(se3.exp(made.xi)))
    # Slip is visible in the image only: shallow contacts keep labels of large shear.
    assert np.hypot(*contacts[contacts[:, 2] < 2.0][:, :2].T).max() > 3.0
    assert all(300 < len(each) <= 331 for each in made.frames)
    assert imagined.preprocessing("markers").output_size == SIZE
    assert imagined.preprocessing("gdn").output_size == (128, 128)
    assert Imagined().preprocessing("markers").threshold is not None


@pytest.mark.timeout(400)
def test_calibrate_sim_fits_simulated_images_and_reports_the_residual(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_split(tmp_path / "data", "train", 100, seed=1)
    calibrate_sim(tmp_path / "data", tmp_path / "sensor.yaml", frames=20, images=100, guess_steps=30)
    fitted = load_tip(str(tmp_path / "sensor.yaml"))
    assert fitted.measured["train, held out px"] < 1.5
    assert fitted.tip.disc_radius_px == pytest.approx(6.2, abs=0.3)
    assert "train, held" in capsys.readouterr().out
    assert (tmp_path / "sensor.png").stat().st_size > 10_000
