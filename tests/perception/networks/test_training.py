from __future__ import annotations

import dataclasses
import io
import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

torch = pytest.importorskip("torch")

from tests.helpers.tactile_samples import CENTRE, draw, labelled, preprocessing, taught, write_split  # noqa: E402
from touchcell.drivers.replay.dataset import REST_IMAGE  # noqa: E402
from touchcell.errors import DataError  # noqa: E402
from touchcell.perception.errors import ModelError, TrainingError  # noqa: E402
from touchcell.perception.models.architecture import Architecture  # noqa: E402
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact  # noqa: E402
from touchcell.perception.models.model_file import Model, load_model  # noqa: E402
from touchcell.perception.networks.checkpoint import EpochRecord, checkpoint_path  # noqa: E402
from touchcell.perception.networks.dataset import LabelledImages  # noqa: E402
from touchcell.perception.networks.progress import Display  # noqa: E402
from touchcell.perception.networks.trainer import train  # noqa: E402
from touchcell.perception.networks.training import Settings, learning_rate, preprocessing_for, train_on_arrays  # noqa: E402

ARCHITECTURE = Architecture(input_size=(32, 32), channels=(8, 16), hidden=32)
QUICK = Settings(epochs=4, batch_size=16, learning_rate=3e-3)


class Recorder:
    """Records the progress of a training, and interrupts it after an epoch."""

    def __init__(self, interrupt_after: int = 0) -> None:
        self.records: list[EpochRecord] = []
        self.batches: list[tuple[int, int, int, int]] = []
        self.decoded: dict[str, int] = {}
        self._interrupt_after = interrupt_after

    def images(self, split: str, done: int, total: int) -> None:
        assert done <= total
        self.decoded[split] = done

    def batch(self, epoch: int, epochs: int, done: int, total: int, loss: float) -> None:
        self.batches.append((epoch, epochs, done, total))
        if self._interrupt_after and epoch > self._interrupt_after and done == 2:
            raise KeyboardInterrupt

    def epoch(self, record: EpochRecord, *, best: bool) -> None:
        self.records.append(record)


@pytest.fixture(scope="module")
def sets() -> tuple[LabelledImages, LabelledImages]:
    return labelled(240, seed=1), labelled(60, seed=2)


def quick_train(sets: tuple[LabelledImages, LabelledImages], out: Path, **changes: object) -> Model:
    arguments = {"preprocessing": preprocessing(), "architecture": ARCHITECTURE, "settings": QUICK, **changes}
    return train_on_arrays(*sets, out, **arguments)


@pytest.mark.parametrize("kind", ["gdn", "cnn"])
def test_learns_and_writes_model_and_figures(
    sets: tuple[LabelledImages, LabelledImages], tmp_path: Path, kind: str
) -> None:
    out = tmp_path / "new" / "model.safetensors"
    recorder = Recorder()
    reference = np.zeros((32, 32), np.uint8)
    model = quick_train(
        sets,
        out,
        architecture=ARCHITECTURE.model_copy(update={"kind": kind}),
        settings=dataclasses.replace(QUICK, epochs=12),
        observer=recorder,
        reference=reference,
    )
    first, last = recorder.records[0].mae, recorder.records[-1].mae
    assert last["x_mm"] < 0.5 * 2.5  # 2.5 is the error of the mean label.
    assert last["z_mm"] < first["z_mm"]
    assert len(recorder.batches) == 12 * 15
    header = load_model(out).header
    assert header == model.header
    assert header.training["images"] == 240
    np.testing.assert_allclose(header.labels.low, contact_from_xi(sets[0].xi).min(axis=0))
    assert header.labels.are_contacts
    np.testing.assert_array_equal(load_model(out).reference, reference)
    assert sorted(path.name for path in out.parent.iterdir()) == [
        "model.safetensors",
        "model_curves.png",
        "model_predictions.png",
    ]
    for figure in ("curves", "predictions"):
        drawn = cv2.imread(str(out.with_name(f"model_{figure}.png")))
        assert min(drawn.shape[:2]) > 300
        assert drawn.std() > 5.0


def test_same_seed_same_file_other_seed_other_file(sets: tuple[LabelledImages, LabelledImages], tmp_path: Path) -> None:
    state = torch.random.get_rng_state()
    files = []
    for i, seed in enumerate((0, 0, 1)):
        quick_train(sets, tmp_path / f"{i}.safetensors", settings=dataclasses.replace(QUICK, seed=seed))
        files.append(taught(tmp_path / f"{i}.safetensors"))
    assert files[0] == files[1] != files[2]
    assert torch.equal(torch.random.get_rng_state(), state)


def test_interrupted_training_ends_in_the_same_model(
    sets: tuple[LabelledImages, LabelledImages], tmp_path: Path
) -> None:
    whole, parts = tmp_path / "whole.safetensors", tmp_path / "parts.safetensors"
    uninterrupted = Recorder()
    quick_train(sets, whole, observer=uninterrupted)
    for after in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            quick_train(sets, parts, observer=Recorder(interrupt_after=after))
        assert not parts.exists()
        assert checkpoint_path(parts).exists()
    rest = Recorder()
    quick_train(sets, parts, observer=rest)
    assert taught(parts) == taught(whole)
    assert [record.epoch for record in rest.records] == [3, 4]
    assert rest.records == uninterrupted.records[2:]
    assert not checkpoint_path(parts).exists()


def test_checkpoint_of_another_training_is_refused_or_overwritten(
    sets: tuple[LabelledImages, LabelledImages], tmp_path: Path
) -> None:
    out = tmp_path / "model.safetensors"
    with pytest.raises(KeyboardInterrupt):
        quick_train(sets, out, observer=Recorder(interrupt_after=1))
    other = dataclasses.replace(QUICK, seed=5)
    with pytest.raises(TrainingError, match="other settings"):
        quick_train(sets, out, settings=other)
    with pytest.raises(TrainingError, match="other data"):
        quick_train((labelled(100, seed=3), sets[1]), out)
    anew = Recorder()
    quick_train(sets, out, settings=other, resume=False, observer=anew)
    assert [record.epoch for record in anew.records] == [1, 2, 3, 4]


def test_damaged_checkpoint(sets: tuple[LabelledImages, LabelledImages], tmp_path: Path) -> None:
    out = tmp_path / "model.safetensors"
    checkpoint_path(out).write_bytes(b"\x10" * 100)
    with pytest.raises(TrainingError, match="cannot be read"):
        quick_train(sets, out)


@pytest.mark.parametrize("rate", [1e38, 1e6])
def test_extreme_learning_rate_writes_nothing(
    sets: tuple[LabelledImages, LabelledImages], tmp_path: Path, rate: float
) -> None:
    out = tmp_path / "model.safetensors"
    with pytest.raises((TrainingError, ModelError)):
        quick_train(sets, out, settings=dataclasses.replace(QUICK, learning_rate=rate, epochs=2))
    assert not out.exists()
    assert not checkpoint_path(out).exists()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_learning_rate(rate: float) -> None:
    with pytest.raises(TrainingError):
        dataclasses.replace(QUICK, learning_rate=rate)


@pytest.mark.parametrize("changes", [{"memory": 1.0}, {"epochs": 0}, {"patience": 0}, {"batch_size": 1}])
def test_impossible_settings(changes: dict[str, float]) -> None:
    with pytest.raises(TrainingError):
        dataclasses.replace(QUICK, **changes)


def test_constant_labels(sets: tuple[LabelledImages, LabelledImages], tmp_path: Path) -> None:
    constant = contact_from_xi(sets[0].xi)
    constant[:, 2] = 1.0
    with pytest.raises(TrainingError, match="z_mm"):
        quick_train((LabelledImages(sets[0].images, xi_from_contact(constant)), sets[1]), tmp_path / "m.safetensors")


@pytest.mark.parametrize("which", [0, 1])
def test_nan_labels(sets: tuple[LabelledImages, LabelledImages], tmp_path: Path, which: int) -> None:
    damaged = [*sets]
    damaged[which] = LabelledImages(sets[which].images, np.where(np.arange(6) == 3, np.nan, sets[which].xi))
    with pytest.raises(TrainingError, match="six finite components"):
        quick_train((damaged[0], damaged[1]), tmp_path / "m.safetensors")


def test_stops_when_validation_gets_no_better(sets: tuple[LabelledImages, LabelledImages], tmp_path: Path) -> None:
    recorder = Recorder()
    small = LabelledImages(sets[0].images[:48], sets[0].xi[:48])
    settings = dataclasses.replace(QUICK, epochs=200, patience=3, learning_rate=1e-2)
    model = quick_train((small, sets[1]), tmp_path / "m.safetensors", settings=settings, observer=recorder)
    losses = [record.validation_loss for record in recorder.records]
    assert len(losses) < 200
    assert int(np.argmin(losses)) + 1 == len(losses) - 3 == model.header.training["best_epoch"]


def test_learning_rate_rises_holds_and_falls() -> None:
    rates = [learning_rate(step, 1000, 2e-3) for step in range(1000)]
    assert rates[0] == pytest.approx(2e-5)
    assert rates[25] == pytest.approx(2e-3 * 0.505)
    assert rates[50] == rates[69] == 2e-3
    assert rates[70 + 465] == pytest.approx(1e-3)
    assert 2e-7 <= rates[-1] < 4e-6
    assert all(a >= b for a, b in itertools.pairwise(rates[50:]))


def test_trains_from_a_folder(tmp_path: Path) -> None:
    data = tmp_path / "data"
    write_split(data, "train", n=64, seed=1)
    write_split(data, "val", n=32, seed=2)
    cv2.imwrite(str(data / REST_IMAGE), draw(CENTRE))
    text = io.StringIO()
    recorder = Recorder()
    out = tmp_path / "model.safetensors"
    train(data, out, settings={"epochs": 2}, seed=3, cache=tmp_path / "cache", observer=recorder)
    assert recorder.decoded == {"train": 64, "val": 32}
    model = load_model(out)
    header = model.header
    np.testing.assert_array_equal(model.reference, header.preprocessing.reduce(draw(CENTRE)))
    assert header.preprocessing.input_size == (44, 48)
    assert header.architecture == Architecture(input_size=(44, 48))
    assert header.training["seed"] == 3

    display = Display(Console(file=text, width=80))
    with display:
        for record in recorder.records:
            display.epoch(record, best=True)
    lines = text.getvalue().splitlines()
    assert len(lines) == 3
    assert "gamma_deg" in lines[0]
    assert f"{recorder.records[1].mae['gamma_deg']:.3f}" in lines[2]


@pytest.mark.parametrize(
    ("size", "crop", "reduced"),
    [
        ((440, 445), (0, 0, 444, 440), (110, 111)),
        ((480, 640), None, (120, 160)),
        ((44, 48), None, (44, 48)),
    ],
)
def test_images_shrink_by_whole_numbers(
    size: tuple[int, int], crop: tuple[int, ...] | None, reduced: tuple[int, int]
) -> None:
    preprocessing = preprocessing_for(np.zeros(size, np.uint8))
    assert preprocessing.crop == crop
    assert preprocessing.output_size == reduced


def test_a_short_side_shrinks_further(tmp_path: Path) -> None:
    image = np.zeros((440, 445), np.uint8)
    assert preprocessing_for(image, 70).output_size == (73, 74)
    assert preprocessing_for(image, 440).output_size == (440, 445)
    with pytest.raises(TrainingError):
        preprocessing_for(image, 31)
    with pytest.raises(TrainingError):
        train(tmp_path, tmp_path / "m.safetensors", kind="markers", settings={"short_side_px": 70}, observer=Recorder())


def test_number_of_networks_is_for_markers_alone(tmp_path: Path) -> None:
    with pytest.raises(TrainingError):
        train(tmp_path, tmp_path / "m.safetensors", kind="gdn", settings={"networks": 2}, observer=Recorder())


def test_damaged_data_set_writes_nothing(tmp_path: Path) -> None:
    write_split(tmp_path / "data", "train", n=4, seed=1)
    with pytest.raises(DataError) as caught:
        train(tmp_path / "data", tmp_path / "m.safetensors", observer=Recorder(), cache=tmp_path / "cache")
    assert caught.value.file == tmp_path / "data" / "val"
    assert not (tmp_path / "m.safetensors").exists()
