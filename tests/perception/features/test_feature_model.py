"""What a tip touches: the classifier, its file, and what is drawn to train it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchcell.perception.errors import ModelError
from touchcell.perception.features.feature_model import (
    CLASSES,
    FeatureModel,
    TouchedFeature,
    load_feature_model,
    save_feature_model,
)
from touchcell.simulation.feature_samples import feature_contacts


def made(seed: int = 0, markers: int = 5) -> FeatureModel:
    rng = np.random.default_rng(seed)
    shapes = [(2 * markers, 8), (8, len(CLASSES))]
    weights = tuple(rng.normal(0.0, 1.0, shape).astype(np.float32) for shape in shapes)
    return FeatureModel(weights, tuple(np.zeros(shape[1], np.float32) for shape in shapes), 2.0)


def test_probabilities_add_up_to_one_and_a_higher_temperature_is_less_sure() -> None:
    model, fields = made(), np.random.default_rng(1).normal(0.0, 3.0, (50, 10))
    probabilities = model.probabilities(fields)
    assert probabilities.sum(axis=1) == pytest.approx(np.ones(50))
    surer = replace(model, temperature=1.0).probabilities(fields)
    assert (surer.max(axis=1) >= probabilities.max(axis=1)).all()
    one = model.touched(fields[0].reshape(5, 2))
    assert one.likeliest == CLASSES[int(probabilities[0].argmax())]
    assert one.along_an_edge == pytest.approx(probabilities[0, 2] + probabilities[0, 3])


def test_a_classifier_is_the_same_after_writing_and_reading(tmp_path: Path) -> None:
    model, field = made(), np.linspace(-3.0, 3.0, 10)
    save_feature_model(model, tmp_path / "kinds.safetensors")
    again = load_feature_model(tmp_path / "kinds.safetensors")
    assert np.array_equal(again.probabilities(field), model.probabilities(field))
    assert again.markers == 5


@pytest.mark.parametrize("content", [None, b"", b"no model at all", b"\x08\x00\x00\x00\x00\x00\x00\x00{}      "])
def test_what_is_no_classifier_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "kinds.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ModelError, match=r"kinds\.safetensors"):
        load_feature_model(path)


def test_the_likeliest_of_equal_probabilities_is_the_least_committal() -> None:
    assert TouchedFeature(0.25, 0.25, 0.25, 0.25).likeliest == "none"


def test_drawn_features_are_the_same_for_the_same_seed_and_of_every_class() -> None:
    one, two = list(feature_contacts(40, 3)), list(feature_contacts(40, 3))
    assert [kind for kind, _ in one] == [kind for kind, _ in two]
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(one, two, strict=True))
    assert {kind for kind, _ in one} == set(range(len(CLASSES)))
    assert all(np.isfinite(pixels).all() for _, pixels in one)
