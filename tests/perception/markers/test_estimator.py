from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.marker_samples import SIZE, simulated, write_split
from tests.helpers.tactile_samples import taught
from tests.perception.models.test_model_file import make_model
from tests.perception.runtime.test_pipeline import StubCamera

torch = pytest.importorskip("torch")

from touchcell.drivers.core.clock import VirtualClock  # noqa: E402
from touchcell.geometry import se3  # noqa: E402
from touchcell.perception.errors import ImageError, ModelError, TrainingError  # noqa: E402
from touchcell.perception.markers.estimator import MarkerEstimator  # noqa: E402
from touchcell.perception.markers.layers import mixed  # noqa: E402
from touchcell.perception.markers.matching import DisplacementModel, MarkerField  # noqa: E402
from touchcell.perception.models.model_file import Labels, Model, load_model, save_model  # noqa: E402
from touchcell.perception.networks.checkpoint import EpochRecord, checkpoint_path  # noqa: E402
from touchcell.perception.networks.contact_network import Alignment  # noqa: E402
from touchcell.perception.networks.displacement_network import DisplacementNetwork, displacement_loss  # noqa: E402
from touchcell.perception.networks.evaluate import evaluate  # noqa: E402
from touchcell.perception.networks.marker_training import MarkerSettings, preprocessing_for, train_markers  # noqa: E402
from touchcell.perception.runtime.estimators import load_estimator  # noqa: E402
from touchcell.perception.runtime.inference import ContactModel  # noqa: E402
from touchcell.perception.runtime.pipeline import ContactPipeline  # noqa: E402

QUICK = MarkerSettings(epochs=8, networks=2, hidden=(96, 48), modes=16, guess_steps=30, batch_size=16, memory=0.95)


class Recorder:
    """Records the progress of a training, and interrupts it after an epoch."""

    def __init__(self, interrupt_after: int = 0) -> None:
        self.records: list[EpochRecord] = []
        self.calls: dict[str, tuple[int, int]] = {}
        self.batches = 0
        self._interrupt_after = interrupt_after

    def images(self, split: str, done: int, total: int) -> None:
        self.calls[split] = (done, total)

    def batch(self, epoch: int, epochs: int, done: int, total: int, loss: float) -> None:
        if self._interrupt_after and epoch > self._interrupt_after:
            raise KeyboardInterrupt
        self.batches = total

    def epoch(self, record: EpochRecord, *, best: bool) -> None:
        self.records.append(record)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_split(root, "train", 160, seed=1)
    write_split(root, "val", 40, seed=2)
    return root


@pytest.fixture(scope="module")
def trained(data: Path) -> Path:
    out = data / "markers.safetensors"
    recorder = Recorder()
    train_markers(data, out, settings=QUICK, cache=data / "cache", observer=recorder)
    assert recorder.calls["train"] == (160, 160)
    assert recorder.calls["matched"][0] == recorder.calls["matched"][1]
    assert len(recorder.records) == 8
    # Ten batches hold all images once.
    assert recorder.batches >= 16
    return out


def test_few_images_suffice_to_learn_contacts(data: Path, trained: Path) -> None:
    for name in ("markers_predictions.png", "markers_curves.png", "markers_markers.png"):
        assert (data / name).stat().st_size > 10_000
    result = evaluate(data, "val", trained)
    assert result.n == 40
    # Well below the error of the constant centre of the range: 1.4 mm, 2 mm, 10 deg.
    assert result.mae["z_mm"] < 0.5 * 1.4
    assert result.mae["x_mm"] < 0.5 * 2.0
    assert result.mae["alpha_deg"] < 0.8 * 10.0
    assert np.isfinite(result.nll)
    assert 0.0 < result.latency_ms["median"] <= result.latency_ms["p99"]


def test_file_alone_decides_the_kind(trained: Path, tmp_path: Path) -> None:
    assert isinstance(load_estimator(trained), MarkerEstimator)
    save_model(make_model(), tmp_path / "cnn.safetensors")
    assert isinstance(load_estimator(tmp_path / "cnn.safetensors"), ContactModel)
    with pytest.raises(ModelError) as caught:
        MarkerEstimator.load(tmp_path / "cnn.safetensors")
    assert caught.value.key == "architecture.kind"
    with pytest.raises(TypeError):
        ContactModel(load_model(trained))


def test_file_holds_all_of_the_model(trained: Path, tmp_path: Path) -> None:
    model = load_model(trained)
    save_model(Model(model.header, model.tensors, np.zeros(SIZE, np.uint8)), tmp_path / "copy.safetensors")
    copy, original = load_estimator(tmp_path / "copy.safetensors"), load_estimator(trained)
    assert copy.header == original.header
    assert copy.reference is not None
    assert original.reference is None
    for image in simulated(5, seed=4).images:
        one, other = copy.predict(image), original.predict(image)
        np.testing.assert_array_equal(one.xi, other.xi)
        np.testing.assert_array_equal(one.sigma, other.sigma)


def test_order_of_images_does_not_matter(trained: Path) -> None:
    images = simulated(12, seed=5).images
    estimator = load_estimator(trained)
    forwards = [estimator.predict(image) for image in images]
    alone = [load_estimator(trained).predict(image) for image in images]
    for one, other in zip(forwards, alone, strict=True):
        assert one.in_range == other.in_range
        if one.in_range:
            np.testing.assert_allclose(one.xi, other.xi, atol=2e-4)


@pytest.mark.parametrize("name", ["black", "white", "noise", "few", "half"])
def test_images_without_a_lattice_are_reported(trained: Path, name: str) -> None:
    rng = np.random.default_rng(0)
    lit = simulated(1, seed=6).images[0]
    images = {
        "black": np.zeros(SIZE, np.uint8),
        "white": np.full(SIZE, 255, np.uint8),
        "noise": (rng.random(SIZE) < 0.3).astype(np.uint8) * 255,
        "few": np.where(np.arange(SIZE[1]) < 60, lit, 0).astype(np.uint8),
        "half": np.where(np.arange(SIZE[0])[:, None] < 200, lit, 0).astype(np.uint8),
    }
    estimator = load_estimator(trained)
    prediction = estimator.predict(images[name])
    assert not prediction.in_range
    widest = np.sqrt(np.diagonal(estimator.header.labels.xi_gaussian(np.zeros(6), np.ones(6))[1]))
    assert (prediction.sigma > 0.5 * widest).all()
    assert prediction.markers is not None
    assert prediction.markers < 0.9
    whole = load_estimator(trained).predict(lit)
    assert whole.markers is not None
    assert whole.markers > 0.95
    assert np.isfinite(prediction.xi).all()
    assert np.isfinite(prediction.sigma).all()
    assert (prediction.sigma > 0.0).all()


def test_image_of_another_size_is_refused(trained: Path) -> None:
    with pytest.raises(ImageError):
        load_estimator(trained).predict(np.zeros((480, 640), np.uint8))


def test_pipeline_runs_on_markers(trained: Path) -> None:
    sample = simulated(3, seed=7, depth_mm=(2.0, 4.0))
    clock = VirtualClock()
    pipeline = ContactPipeline(StubCamera(clock, sample.images), load_estimator(trained))  # type: ignore[arg-type]
    estimate = pipeline.update(clock.now_ns())
    assert estimate is not None
    assert estimate.belief is not None
    depth_mm = se3.to_euler_mm_deg(se3.inverse(estimate.belief.mean))[2]
    assert abs(depth_mm - se3.to_euler_mm_deg(sample.T_f_s[0])[2]) < 2.0


def test_interrupted_training_ends_in_the_same_model(data: Path, trained: Path) -> None:
    out = data / "parts.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train_markers(data, out, settings=QUICK, cache=data / "cache", observer=Recorder(interrupt_after=3))
    assert checkpoint_path(out).exists()
    assert not out.exists()
    rest = Recorder()
    train_markers(data, out, settings=QUICK, cache=data / "cache", observer=rest)
    assert [record.epoch for record in rest.records] == [4, 5, 6, 7, 8]
    assert "matched" not in rest.calls
    assert taught(out) == taught(trained)
    assert 0.0 < load_model(out).header.training["epochs_cpu_s"] < 600.0


def test_extreme_learning_rate_writes_nothing(data: Path, trained: Path) -> None:
    out = data / "extreme.safetensors"
    settings = dataclasses.replace(QUICK, learning_rate=1e6)
    with pytest.raises((TrainingError, ModelError)):
        train_markers(data, out, settings=settings, cache=data / "cache", observer=Recorder())
    assert not out.exists()
    assert not checkpoint_path(out).exists()


@pytest.mark.parametrize(
    "changes", [{"learning_rate": float("nan")}, {"epochs": 0}, {"networks": 0}, {"batch_size": 1}]
)
def test_impossible_settings(changes: dict[str, float]) -> None:
    with pytest.raises(TrainingError):
        dataclasses.replace(QUICK, **changes)  # type: ignore[arg-type]


def test_numpy_and_torch_agree(trained: Path) -> None:
    model = load_model(trained)
    tensors = {name: tensor.astype(np.float64) for name, tensor in model.tensors.items()}
    displacement_model = DisplacementModel(
        tensors["lattice"], tensors["displacement.mean"], tensors["displacement.basis"], tensors["displacement.sd"]
    )
    torch.manual_seed(0)
    network = DisplacementNetwork(displacement_model, QUICK.hidden, QUICK.networks).eval()
    estimator = MarkerEstimator(Model(model.header, {**model.tensors, **network.folded()}))
    for displacements in np.random.default_rng(0).normal(0.0, 8.0, (5, 331, 2)):
        with torch.no_grad():
            inputs = torch.from_numpy(displacements.ravel().astype(np.float32))
            outputs = network(inputs.expand(QUICK.networks, 1, -1)).numpy()[:, 0].astype(np.float64)
        mean, sigma = mixed(outputs[:, :6], outputs[:, 12:], model.header.labels)
        field = MarkerField(
            displacements,
            displacements,
            np.ones(331, bool),
            np.zeros(QUICK.modes),
            score=1.0,
            rms_px=0.1,
            explained=1.0,
            valid=True,
        )
        found = estimator.infer(field)
        np.testing.assert_allclose(found[0], mean, atol=1e-4)
        np.testing.assert_allclose(found[1], sigma, rtol=1e-3)


def test_mixture_of_gaussians() -> None:
    labels = Labels.of_contacts((-2.0,) * 6, (2.0,) * 6)
    means, deviations = np.zeros((2, 6)), np.ones((2, 6))
    means[:, 2] = [1.0, 3.0]
    deviations[1] = 2.0
    # One network says (3, 3) mm and the other (5, 5): they differ along the shear alone.
    means[:, :2] = [[1.5, 1.5], [2.5, 2.5]]
    mean, sigma = mixed(means, -np.log(deviations), labels)
    np.testing.assert_allclose(mean[:3], 2.0)
    np.testing.assert_allclose(sigma**2, [2.5 + 0.5, 2.5, 2.5 + 1.0, 2.5, 2.5, 2.5])


def test_loss_prefers_the_truth_and_honest_scales() -> None:
    labels = torch.zeros(1, 4000, 6)
    alignment = Alignment(Labels.of_contacts((-1.0,) * 6, (1.0,) * 6))
    errors = torch.distributions.Laplace(0.0, 0.1).sample((1, 4000, 6))

    def loss(scale: float, sigma: float) -> float:
        logs = [torch.full_like(errors, -np.log(value)) for value in (scale, sigma)]
        return displacement_loss(torch.cat([errors, *logs], dim=-1), labels, alignment).item()

    # The standard deviation of a Laplace density of scale 0.1 is 0.141.
    assert loss(0.1, 0.141) < loss(0.1, 0.1)
    assert loss(0.1, 0.141) < loss(0.1, 0.2)
    exact = torch.cat([torch.zeros_like(errors), torch.full((1, 4000, 12), 2.0)], dim=-1)
    off = exact + torch.cat([torch.full_like(errors, 0.1), torch.zeros(1, 4000, 12)], dim=-1)
    assert displacement_loss(exact, labels, alignment) < displacement_loss(off, labels, alignment)


def test_grey_images_are_thresholded_and_binary_ones_are_left_alone() -> None:
    assert preprocessing_for(simulated(1, seed=1).images[0]).threshold is None
    assert preprocessing_for(np.full(SIZE, 90, np.uint8)).threshold is not None


def test_a_running_cell_carries_no_torch(trained: Path) -> None:
    program = (
        "import sys, numpy; from pathlib import Path\n"
        "from touchcell.perception.runtime.estimators import load_estimator\n"
        f"load_estimator(Path(sys.argv[1])).predict(numpy.zeros({SIZE}, numpy.uint8))\n"
        "print(sorted({'torch', 'matplotlib', 'rich', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program, str(trained)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
