from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tests.perception.models.test_model_file import make_model

pytest.importorskip("torch")

from benchmarks.adapt import _drawn, _errors, second_sensor
from tests.helpers.marker_samples import SIZE, write_split
from touchcell.cell.cli.calibrate_sim import calibrate_sim
from touchcell.cell.cli.train_sim import Imagined, _discs
from touchcell.drivers.replay.dataset import PUBLIC_CROP
from touchcell.geometry import se3
from touchcell.perception.calibration.adaptation import (
    AdaptSettings,
    about_z,
    adapt,
    adapt_to,
    align_to_sensor,
    layers_of,
    outputs_of,
    tune,
)
from touchcell.perception.errors import ModelError, TrainingError
from touchcell.perception.markers.detection import Discs
from touchcell.perception.markers.estimator import matcher_of
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.models.marker_architecture import MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Header, Labels, Model, save_model
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.marker_learning import train_guess
from touchcell.perception.networks.marker_training import LabelledDiscs
from touchcell.perception.runtime.calibrated_estimator import turned
from touchcell.perception.runtime.estimators import load_estimator
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import load_tip

TIP, RIG = TipParameters(), MountModel()
SETTINGS = AdaptSettings(steps=80)
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
    labels = Labels(low=tuple(xi.min(axis=0).tolist()), high=tuple(xi.max(axis=0).tolist()))
    tensors = {
        "lattice": reference,
        "displacement.mean": moves.mean,
        "displacement.basis": moves.basis,
        "displacement.sd": moves.sd,
        "bank": coefficients,
        "guess.hidden.weight": guess.hidden_weight,
        "guess.hidden.bias": guess.hidden_bias,
        "guess.output.weight": guess.weight,
        "guess.output.bias": guess.bias,
        "guess.sd": guess.sd,
    }
    for name, shape in architecture.tensor_shapes().items():
        if name.startswith("layer"):
            scale = 0.1 / np.sqrt(shape[1]) if name == "layer0.weight" else 1.0 / np.sqrt(shape[1])
            tensors[name] = rng.uniform(-scale, scale, shape) if "weight" in name else np.zeros(shape)
    header = Header(
        touchcell_version="0.1.0",
        architecture=architecture,
        preprocessing=Preprocessing(input_size=SIZE, output_size=SIZE),
        labels=labels,
        sigma_scale=(1.0,) * 6,
        training_data="00",
    )
    made = Model(header, {name: np.ascontiguousarray(each, np.float32) for name, each in tensors.items()})
    settings = AdaptSettings(steps=500, hold=0.0, learning_rate=3e-3, batch_size=64)
    target = (xi - labels.centre) / labels.half_range
    trained = tune(made, layers_of(made), displacements.reshape(500, -1).astype(np.float32), target, settings)
    for i, (weight, bias) in enumerate(trained):
        made.tensors[f"layer{i}.weight"] = weight.astype(np.float32)
        made.tensors[f"layer{i}.bias"] = bias.astype(np.float32)
    return made


def test_another_camera_and_other_axes_cost_almost_no_accuracy(model: Model) -> None:
    own = _drawn(TIP, RIG, 60, 5, model)
    turn = np.radians(-130.0)
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    middle = np.array([222.0, 219.0])
    frames = [Discs((each.centres - middle) @ spin.T * 1.05 + middle + 4.0, each.areas) for each in own.frames]
    other = LabelledDiscs(frames, about_z(np.radians(35.0), own.xi))
    brought = align_to_sensor(model, other)
    assert brought.camera.zoom == pytest.approx(1 / 1.05, abs=0.03)
    assert brought.matched.mean() > 0.9
    # The lattice is ambiguous by 60 degrees; camera and labels have to agree on one.
    off = (brought.camera.turn_deg - 130.0 + 180) % 360 - 180
    assert off % 60 == pytest.approx(0.0, abs=2.0) or off % 60 == pytest.approx(60.0, abs=2.0)
    before, _ = _errors(model, own)
    adapted = adapt_to(model, other, preprocessing=model.header.preprocessing, size=SIZE_OF_MARKERS, settings=SETTINGS)
    after, matched = _errors(adapted, LabelledDiscs(frames, other.xi))
    assert matched > 0.9
    assert (after < 1.5 * before + 0.1).all()


def test_thirty_images_adapt_it_to_another_sensor(model: Model, tmp_path: Path) -> None:
    tip, rig = second_sensor(TIP, RIG)
    few, held_out = (_drawn(tip, rig, n, seed, model) for n, seed in ((30, 7), (60, 8)))
    before, seen_before = _errors(model, held_out)
    adapted = adapt_to(model, few, preprocessing=model.header.preprocessing, size=SIZE_OF_MARKERS, settings=SETTINGS)
    after, seen = _errors(adapted, held_out)
    assert seen_before < 0.5 < 0.9 < seen
    assert (after[[0, 1, 3, 4]] < 0.5 * before[[0, 1, 3, 4]]).all()
    save_model(adapted, tmp_path / "adapted.safetensors")
    estimator = load_estimator(tmp_path / "adapted.safetensors")
    assert estimator.header.training["adapted_images"] == 30
    with pytest.raises(ModelError, match="adapted already"):
        adapt(tmp_path / "adapted.safetensors", tmp_path, tmp_path / "again.safetensors")


def test_turned_predictions_are_about_turned_axes() -> None:
    xi = np.array([1e-3, -2e-3, -4e-3, 0.2, -0.3, 0.05])
    root = np.random.default_rng(0).normal(size=(6, 6))
    found = turned(Prediction(xi, root @ root.T, in_range=True), 40.0)
    Z = se3.from_euler_mm_deg([0, 0, 0, 0, 0, 40.0])
    np.testing.assert_allclose(se3.exp(found.xi), Z @ se3.exp(xi) @ se3.inverse(Z), atol=1e-12)
    np.testing.assert_allclose(found.xi, about_z(np.radians(40.0), xi[None])[0])
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
    from touchcell.perception.markers.estimator import MarkerEstimator

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
        align_to_sensor(model, dataclasses.replace(few, frames=shuffled))
    with pytest.raises(TrainingError, match="are needed"):
        align_to_sensor(model, LabelledDiscs(few.frames[:6], few.xi[:6]))


def test_samples_of_a_real_sensor_are_labelled_with_the_command() -> None:
    imagined = Imagined(load_tip("franka_tactip_1"), processed=True)
    made = _discs(imagined, 40, 3)
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
