"""Training on unsuitable data: finite outputs with honest uncertainty, or a typed error."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from tests.helpers.tactile_samples import labelled, preprocessing
from touchcell.geometry.types import Array
from touchcell.perception.errors import TrainingError
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact
from touchcell.perception.models.model_file import load_model
from touchcell.perception.networks.dataset import LabelledImages
from touchcell.perception.networks.training import Settings, train_on_arrays
from touchcell.perception.runtime.inference import ContactModel

ARCHITECTURE = Architecture(input_size=(32, 32), channels=(4, 8), hidden=16)
Sets = tuple[LabelledImages, LabelledImages]


@pytest.fixture(scope="module")
def sets() -> Sets:
    return labelled(48, seed=1), labelled(32, seed=2)


def trained(sets: Sets, out: Path, kind: str, learning_rate: float = 3e-3) -> tuple[Array, Array]:
    """Train briefly.

    Return means and standard deviations of xi that the written file predicts for the validation set.
    """
    settings = Settings(epochs=2, batch_size=16, learning_rate=learning_rate)
    train_on_arrays(
        *sets,
        out,
        preprocessing=preprocessing(),
        architecture=ARCHITECTURE.model_copy(update={"kind": kind}),
        settings=settings,
    )
    for tensor in load_model(out).tensors.values():
        assert np.isfinite(tensor).all()
    model = ContactModel.load(out)
    predictions = [model.predict_reduced(image) for image in sets[1].images]
    means, sigmas = np.stack([p.xi for p in predictions]), np.stack([p.sigma for p in predictions])
    assert np.isfinite(means).all()
    assert np.isfinite(sigmas).all()
    assert (sigmas > 0.0).all()
    return means, sigmas


def relabelled(sets: Sets, change: object) -> Sets:
    rng = np.random.default_rng(0)
    first, second = (dataclasses.replace(images, xi=change(images.xi, rng)) for images in sets)  # type: ignore[operator]
    return first, second


@pytest.mark.parametrize("kind", ["gdn", pytest.param("cnn", marks=pytest.mark.stress)])
def test_noise_labels_give_large_predicted_standard_deviations(sets: Sets, tmp_path: Path, kind: str) -> None:
    """Nothing can be learned, and the predicted standard deviations show it."""
    noise = relabelled(sets, lambda xi, rng: rng.permutation(xi))
    means, sigmas = trained(noise, tmp_path / "model.safetensors", kind)
    standardised = (noise[1].xi - means) / sigmas
    assert np.sqrt((standardised**2).mean(axis=0)).max() < 1.5
    assert (sigmas.mean(axis=0) > 0.3 * noise[1].xi.std(axis=0)).all()


LONG = pytest.mark.stress


@pytest.mark.parametrize(
    ("kind", "rate"),
    [
        ("gdn", 1e-12),
        ("gdn", 1e3),
        ("cnn", 1e30),
        *(
            pytest.param(kind, rate, marks=LONG)
            for kind in ("gdn", "cnn")
            for rate in (1e-30, 1e-12, 1e-6, 1.0, 1e3, 1e6, 1e12, 1e30, 1e38)
        ),
    ],
)
def test_any_learning_rate_ends_in_a_model_or_an_error(sets: Sets, tmp_path: Path, kind: str, rate: float) -> None:
    out = tmp_path / "model.safetensors"
    with contextlib.suppress(TrainingError):
        trained(sets, out, kind, rate)
        return
    assert not out.exists()


@pytest.mark.parametrize("component", range(6))
def test_one_constant_label_is_named(sets: Sets, tmp_path: Path, component: int) -> None:
    def flatten(xi: Array, rng: np.random.Generator) -> Array:
        flat = contact_from_xi(xi)
        flat[:, component] = 1.0
        return xi_from_contact(flat)

    with pytest.raises(TrainingError, match="same"):
        trained(relabelled(sets, flatten), tmp_path / "model.safetensors", "gdn")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_label_that_is_not_finite(sets: Sets, tmp_path: Path, bad: float) -> None:
    def spoil(xi: Array, rng: np.random.Generator) -> Array:
        spoiled = xi.copy()
        spoiled[7, 3] = bad
        return spoiled

    with pytest.raises(TrainingError, match="finite"):
        trained(relabelled(sets, spoil), tmp_path / "model.safetensors", "gdn")


@pytest.mark.parametrize("size", [0.05, pytest.param(1e3, marks=LONG)])
def test_labels_of_any_size(sets: Sets, tmp_path: Path, size: float) -> None:
    scaled = relabelled(sets, lambda xi, rng: xi * size)
    means, _ = trained(scaled, tmp_path / "model.safetensors", "gdn")
    assert np.abs(means - scaled[1].xi).max() < 10.0 * np.ptp(scaled[0].xi, axis=0).max()


@pytest.mark.parametrize("level", [0, pytest.param(255, marks=LONG)])
def test_blank_images(sets: Sets, tmp_path: Path, level: int) -> None:
    first, second = (dataclasses.replace(images, images=np.full_like(images.images, level)) for images in sets)
    means, _ = trained((first, second), tmp_path / "model.safetensors", "gdn")
    np.testing.assert_allclose(means, np.broadcast_to(means[0], means.shape), atol=1e-9)


def test_one_label_far_out(sets: Sets, tmp_path: Path) -> None:
    def outlier(xi: Array, rng: np.random.Generator) -> Array:
        far = xi.copy()
        far[0, 0] = 1e6
        return far

    trained((relabelled(sets, outlier)[0], sets[1]), tmp_path / "model.safetensors", "gdn")
