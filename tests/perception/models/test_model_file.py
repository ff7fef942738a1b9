from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from tests.helpers.tactile_samples import preprocessing
from touchcell.perception.errors import ModelError
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.model_file import Header, Labels, Model, load_model, save_model

ARCHITECTURE = Architecture(input_size=(32, 32), channels=(3, 5), hidden=7)


def make_model(architecture: Architecture = ARCHITECTURE, *, reference: bool = True) -> Model:
    rng = np.random.default_rng(4)
    return Model(
        Header(
            touchcell_version="0.1.0",
            architecture=architecture,
            preprocessing=preprocessing(),
            labels=Labels(low=(-0.005, -0.005, -0.006, -0.4, -0.4, -0.1), high=(0.005, 0.005, 0.0, 0.4, 0.4, 0.1)),
            sigma_scale=(1.0, 1.1, 1.2, 0.9, 0.8, 0.7),
            training_data="00ff",
            training={"seed": 1, "validation_mae": [0.1, 0.2]},
        ),
        {name: rng.normal(0.0, 0.3, shape).astype(np.float32) for name, shape in architecture.tensor_shapes().items()},
        rng.integers(0, 256, (32, 32), dtype=np.uint8) if reference else None,
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "folder" / "model.safetensors"


def rewrite(path: Path, *, header: object = None, drop: str = "", **tensors: np.ndarray) -> None:
    """Write a model without the checks, as another program might."""
    model = make_model(reference=False)
    kept = {name: tensor for name, tensor in {**model.tensors, **tensors}.items() if name != drop}
    text = model.header.model_dump_json() if header is None else json.dumps(header)
    path.parent.mkdir(exist_ok=True)
    save_file(kept, path, metadata={"touchcell": text})


@pytest.mark.parametrize("reference", [True, False])
def test_a_saved_model_loads_unchanged(path: Path, reference: bool) -> None:
    model = make_model(reference=reference)
    save_model(model, path)
    loaded = load_model(path)
    assert loaded.header == model.header
    assert loaded.tensors.keys() == model.tensors.keys()
    for name, tensor in model.tensors.items():
        np.testing.assert_array_equal(loaded.tensors[name], tensor)
    np.testing.assert_array_equal(loaded.reference, model.reference)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_the_same_model_is_the_same_file(path: Path) -> None:
    save_model(make_model(), path)
    first = path.read_bytes()
    save_model(make_model(), path)
    assert path.read_bytes() == first


def test_missing_file(path: Path) -> None:
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert caught.value.file == path


@pytest.mark.parametrize("length", [0, 4, 100, 2000, -1])
def test_truncated_file(path: Path, length: int) -> None:
    save_model(make_model(), path)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert caught.value.file == path


def test_foreign_files(path: Path) -> None:
    path.parent.mkdir()
    path.write_text("{}" * 100)
    with pytest.raises(ModelError, match="damaged"):
        load_model(path)
    save_file({"weight": np.zeros(3, np.float32)}, path)
    with pytest.raises(ModelError, match="not a touchcell model"):
        load_model(path)


def header_with(**changes: object) -> dict[str, object]:
    return {**json.loads(make_model().header.model_dump_json()), **changes}


@pytest.mark.parametrize(
    ("header", "key"),
    [
        (header_with(format_version=2), "format_version"),
        (header_with(format_version=None), "format_version"),
        ([], "format_version"),
        (header_with(sigma_scale=[1, 1, 1, 1, 1, 0]), "sigma_scale.5"),
        (header_with(surprise=1), "surprise"),
        (header_with(architecture={"kind": "transformer"}), "architecture.kind"),
    ],
)
def test_header_that_cannot_be_used(path: Path, header: object, key: str) -> None:
    rewrite(path, header=header)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert caught.value.key == key


def test_newer_format_asks_for_a_newer_touchcell(path: Path) -> None:
    rewrite(path, header=header_with(format_version=7))
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert "newer touchcell" in caught.value.hint


def test_preprocessing_that_does_not_match_the_network(path: Path) -> None:
    other = {**json.loads(preprocessing(16).model_dump_json())}
    rewrite(path, header=header_with(preprocessing=other))
    with pytest.raises(ModelError, match="input_size"):
        load_model(path)


def test_tensors_that_do_not_match_the_header(path: Path) -> None:
    for key, change in {
        "hidden.bias": {"drop": "hidden.bias"},
        "conv0.weight": {"conv0.weight": np.zeros((3, 1, 5, 5), np.float32)},
        "output.bias": {"output.bias": np.zeros(12, np.float64)},
        "extra": {"extra": np.zeros(1, np.float32)},
        "conv1.bias": {"conv1.bias": np.full(5, np.nan, np.float32)},
        "reference_image": {"reference_image": np.zeros((9, 9), np.uint8)},
    }.items():
        rewrite(path, **change)
        with pytest.raises(ModelError) as caught:
            load_model(path)
        assert caught.value.key == key


def test_nothing_is_written_for_a_model_with_nan(path: Path) -> None:
    model = make_model()
    model.tensors["hidden.weight"][0, 0] = np.nan
    with pytest.raises(ModelError) as caught:
        save_model(model, path)
    assert caught.value.key == "hidden.weight"
    assert not path.exists()


def test_labels_need_a_range() -> None:
    with pytest.raises(ValueError, match="high"):
        Labels(low=(0.0,) * 6, high=(1.0, 1.0, 1.0, 0.0, 1.0, 1.0))
    labels = Labels(low=(-1.0, 0.0, 2.0, 0.0, 0.0, 0.0), high=(1.0, 4.0, 3.0, 1.0, 1.0, 1.0))
    np.testing.assert_allclose(labels.centre[:3], [0.0, 2.0, 2.5])
    np.testing.assert_allclose(labels.half_range[:3], [1.0, 2.0, 0.5])


def test_a_transfer_of_another_version_asks_to_adapt_again(path: Path) -> None:
    rewrite(path, header=header_with(transfer={"markers": 331, "contacts": 20}))
    with pytest.raises(ModelError, match="adapted to its sensor by another version") as caught:
        load_model(path)
    assert caught.value.key.startswith("transfer.")
    assert "touchcell adapt --model" in caught.value.hint
    assert path.name in caught.value.hint
