from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.tactile_samples import SIZE, contacts, draw, preprocessing
from tests.perception.models.test_model_file import make_model
from touchcell.drivers.core.samples import Frame, Quality, Stamped
from touchcell.perception.errors import ImageError
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.model_file import Header, Labels, Model, save_model
from touchcell.perception.runtime.inference import ContactModel, onnx_runtime

IMAGES = [draw(contact) for contact in contacts(8, seed=5)]


@pytest.mark.parametrize("kind", ["gdn", "cnn"])
@pytest.mark.parametrize(("size", "channels"), [(32, (4, 8)), (44, (3, 5, 7)), (128, (16, 32, 64, 128, 256))])
def test_agrees_with_torch(kind: str, size: int, channels: tuple[int, ...]) -> None:
    torch = pytest.importorskip("torch")
    from touchcell.perception.networks.contact_network import ContactNetwork

    torch.manual_seed(2)
    architecture = Architecture(kind=kind, input_size=(size, size), channels=channels, hidden=32)
    network = ContactNetwork(architecture).train()
    steps = preprocessing(size)
    images = torch.from_numpy(np.stack([steps.apply(image) for image in IMAGES]))
    with torch.no_grad():
        for _ in range(3):
            network(images)
        for normalisation in network.normalisations:
            normalisation.bias.normal_()
        expected = network.eval()(images).numpy()
    header = make_model().header.model_copy(update={"architecture": architecture, "preprocessing": steps})
    stored = Model(header, network.folded())
    reduced = [steps.reduce(image) for image in IMAGES]
    for model in (ContactModel(stored), ContactModel(stored, onnx_runtime(stored))):
        outputs = np.stack([model.infer(each) for each in reduced])
        assert np.abs(outputs - expected).max() < 1e-5
    assert np.ptp(expected[:, 0]) > 1e-4


def test_outputs_stay_bounded_for_any_weights() -> None:
    model = make_model()
    for weights in model.tensors.values():
        weights *= 1e6
    estimator = ContactModel(model)
    outputs = np.stack([estimator.infer(preprocessing().reduce(image)) for image in IMAGES])
    assert np.isfinite(outputs).all()
    assert np.abs(outputs[:, :6]).max() <= 3.0
    assert outputs[:, 6:].min() >= -3.0
    assert outputs[:, 6:].max() <= 7.0


def constant_model(kind: str, output: list[float]) -> Model:
    """Return a model with the same output for every image."""
    base = make_model()
    architecture = base.header.architecture.model_copy(update={"kind": kind})
    tensors = {name: np.zeros(shape, np.float32) for name, shape in architecture.tensor_shapes().items()}
    tensors["output.bias"][:] = output
    fields = {
        "architecture": architecture,
        "labels": Labels(low=(-1.0, 0.0, 0.0, 0.0, 0.0, 0.0), high=(1.0, 4.0, 1.0, 1.0, 1.0, 1.0)),
        "sigma_scale": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    }
    return Model(Header.model_validate({**base.header.model_dump(), **fields}), tensors)


def test_mean_and_sigma_are_in_si_units_and_calibrated() -> None:
    prediction = ContactModel(constant_model("cnn", [0.5, -0.5, 0.0, 1.0, -1.0, 0.0])).predict(IMAGES[0])
    np.testing.assert_allclose(prediction.xi, [0.5, 1.0, 0.5, 1.0, 0.0, 0.5])
    np.testing.assert_allclose(prediction.sigma, [1.0, 4.0, 1.5, 2.0, 2.5, 3.0])
    assert prediction.xi.dtype == prediction.sigma.dtype == np.float64

    # A density network's sigma is the scale over its inverse standard deviation; 2 is the centre of those bounds.
    prediction = ContactModel(constant_model("gdn", [0.0] * 6 + [2.0] * 6)).predict(IMAGES[0])
    np.testing.assert_allclose(prediction.xi, [0.0, 2.0, 0.5, 0.5, 0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(prediction.sigma, np.exp(-2.0) * np.array([1.0, 4.0, 1.5, 2.0, 2.5, 3.0]), rtol=1e-5)


def test_predictions_outside_the_training_range_are_marked() -> None:
    assert ContactModel(constant_model("cnn", [1.0, -1.0, 1.04, 0.0, 0.0, 0.0])).predict(IMAGES[0]).in_range
    assert not ContactModel(constant_model("cnn", [0.0, 0.0, 1.2, 0.0, 0.0, 0.0])).predict(IMAGES[0]).in_range
    assert not ContactModel(constant_model("cnn", [0.0, 0.0, 0.0, 0.0, 0.0, -1.2])).predict(IMAGES[0]).in_range


def test_batch_and_reduced_image_give_the_same() -> None:
    model = ContactModel(make_model())
    single = [model.predict(image) for image in IMAGES]
    assert len({tuple(prediction.xi) for prediction in single}) == len(IMAGES)
    for alone, together, reduced in zip(
        single,
        model.predict_batch(IMAGES),
        (model.predict_reduced(model.reduce(image)) for image in IMAGES),
        strict=True,
    ):
        np.testing.assert_allclose(together.xi, alone.xi, atol=2e-7)
        np.testing.assert_allclose(together.sigma, alone.sigma, rtol=1e-5)
        np.testing.assert_array_equal(reduced.xi, alone.xi)
    assert model.predict_batch([]) == []


def test_prediction_keeps_the_stamp_of_its_frame() -> None:
    model = ContactModel(make_model())
    frame = Stamped(Frame(IMAGES[3]), t_ns=17, seq=4, t_device_ns=9, quality=Quality.SUSPECT)
    observed = model.observe(frame)
    assert (observed.t_ns, observed.seq, observed.t_device_ns, observed.quality) == (17, 4, 9, Quality.SUSPECT)
    np.testing.assert_array_equal(observed.value.xi, model.predict(IMAGES[3]).xi)


@pytest.mark.parametrize(
    ("image", "attribute"),
    [
        (np.zeros((SIZE[0] + 1, SIZE[1]), np.uint8), "size"),
        (np.zeros((*SIZE, 3), np.uint8), "channels"),
        (np.zeros(SIZE, np.float32), "dtype"),
    ],
)
def test_model_made_for_another_preprocessing(image: np.ndarray, attribute: str) -> None:
    with pytest.raises(ImageError) as caught:
        ContactModel(make_model()).predict(image)
    assert caught.value.attribute == attribute


def test_inference_does_not_import_torch(tmp_path: Path) -> None:
    save_model(make_model(), tmp_path / "m.safetensors")
    program = (
        "import sys, numpy; from pathlib import Path; from touchcell.perception.runtime.inference import ContactModel\n"
        "model = ContactModel.load(Path(sys.argv[1]))\n"
        f"model.predict(numpy.zeros({SIZE}, numpy.uint8))\n"
        "print(sorted({'torch', 'matplotlib', 'rich', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "m.safetensors")], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_memory_does_not_grow() -> None:
    def resident_kb() -> int:
        status = Path("/proc/self/status")
        if not status.exists():
            pytest.skip("needs /proc")
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmRSS"))

    model = ContactModel(make_model())
    for _ in range(300):
        model.predict(IMAGES[0])
    before = resident_kb()
    for _ in range(3000):
        model.predict(IMAGES[1])
    # 3000 kept images of 32x32 floats would be 12 MB.
    assert resident_kb() - before < 2000
