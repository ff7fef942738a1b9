from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from tests.helpers.tactile_samples import CENTRE, contacts, draw, write_split
from tests.perception.runtime.test_inference import constant_model
from touchcell.drivers.core.clock import VirtualClock
from touchcell.errors import DataError
from touchcell.paths import MODELS
from touchcell.perception.errors import ImageError, ModelError
from touchcell.perception.models.labels import XI_UNITS, xi_from_contact
from touchcell.perception.models.model_file import Labels, load_model, save_model
from touchcell.perception.networks.evaluate import evaluate, print_table, warnings_of

N = 25
HALF = np.array([5e-3, 5e-3, 3e-3, 0.4, 0.4, 0.1])
SIGMA = np.array([3.0, 3.0, 1.5, 12.0, 12.0, 3.0])


class TickingClock(VirtualClock):
    """A clock that advances by 1 ms per reading, by 50 ms at the 20th."""

    def __init__(self) -> None:
        super().__init__()
        self.looks = 0

    def now_ns(self) -> int:
        self.looks += 1
        self.advance_s(0.050 if self.looks == 20 else 0.001)
        return super().now_ns()


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_split(tmp_path / "data", "val", n=N, seed=6)
    return tmp_path / "data"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model that predicts the centre of the range with known uncertainty for every image."""
    base = constant_model("cnn", [0.0] * 6)
    centre = xi_from_contact(CENTRE)
    header = base.header.model_copy(
        update={
            "labels": Labels(low=tuple(centre - HALF), high=tuple(centre + HALF)),
            "sigma_scale": tuple(SIGMA * XI_UNITS / HALF),
        }
    )
    path = tmp_path / "model.safetensors"
    save_model(dataclasses.replace(base, header=header), path)
    return path


def test_figures_are_their_definitions(data: Path, model: Path) -> None:
    calls: list[tuple[int, int]] = []
    evaluation = evaluate(data, "val", model, clock=TickingClock(), progress=lambda done, n: calls.append((done, n)))
    labels = contacts(N, seed=6)
    x, y, z, alpha, beta, gamma = np.abs(labels - CENTRE).mean(axis=0)
    assert evaluation.n == N
    assert list(evaluation.mae) == ["z_mm", "alpha_deg", "beta_deg", "x_mm", "y_mm", "gamma_deg"]
    np.testing.assert_allclose(list(evaluation.mae.values()), [z, alpha, beta, x, y, gamma], rtol=1e-9)

    residual = (xi_from_contact(labels) - xi_from_contact(CENTRE)) / XI_UNITS
    density = np.exp(-0.5 * (residual / SIGMA) ** 2) / (SIGMA * np.sqrt(2.0 * np.pi))
    assert evaluation.nll == pytest.approx(-np.log(density).sum(axis=1).mean(), rel=1e-9)
    inside = (np.abs(residual) < 1.959964 * SIGMA).mean(axis=0)
    assert evaluation.coverage["95"]["z_mm"] == inside[2]
    assert evaluation.coverage["95"]["gamma_deg"] == inside[5]
    assert evaluation.coverage["68"]["x_mm"] == (np.abs(residual[:, 0]) < 0.994458 * SIGMA[0]).mean()
    assert 0.0 < evaluation.coverage["68"]["x_mm"] < 1.0

    assert evaluation.latency_ms["median"] == pytest.approx(1.0)
    assert 20.0 < evaluation.latency_ms["p99"] < 50.0
    assert calls == [(i + 1, N) for i in range(N)]


def test_json_has_the_documented_keys(data: Path, model: Path, tmp_path: Path) -> None:
    evaluation = evaluate(data, "val", model)
    evaluation.write(tmp_path / "out" / "evaluation.json")
    fields = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert list(fields) == [
        "n",
        "mae",
        "nll",
        "latency_ms",
        "mae_of_median",
        "accepted",
        "refusals",
        "coverage",
    ]
    assert list(fields["latency_ms"]) == ["median", "p99"]
    assert fields["n"] == N
    assert fields["mae"] == evaluation.mae


def test_table_shows_every_figure(data: Path, model: Path) -> None:
    evaluation = evaluate(data, "val", model, clock=TickingClock())
    text = io.StringIO()
    print_table(evaluation, Console(file=text, width=100))
    shown = text.getvalue()
    for name, error in evaluation.mae.items():
        assert name in shown
        assert f"{error:.3f}" in shown
    assert f"NLL {evaluation.nll:.3f}" in shown
    assert "1.00 ms" in shown


def test_it_says_how_many_images_are_accepted_and_why_others_are_not_and_what_is_no_better_than_the_median(
    data: Path, model: Path, tmp_path: Path
) -> None:
    evaluation = evaluate(data, "val", model)
    assert evaluation.accepted == 1.0
    assert evaluation.refusals == {}
    labels = contacts(N, seed=6)
    assert evaluation.mae_of_median["z_mm"] == pytest.approx(np.abs(labels - np.median(labels, axis=0)).mean(axis=0)[2])
    # A model that always predicts the middle of its range can be no better than the median.
    assert "z_mm, alpha_deg, beta_deg, x_mm, y_mm, gamma_deg: no better than the median" in warnings_of(evaluation)[0]

    base = load_model(model)
    tensors = {name: np.full_like(each, 9.0) if name.endswith("bias") else each for name, each in base.tensors.items()}
    save_model(dataclasses.replace(base, tensors=tensors), tmp_path / "outside.safetensors")
    refused = evaluate(data, "val", tmp_path / "outside.safetensors")
    assert refused.accepted == 0.0
    assert refused.refusals == {"beyond the contacts that were taught": N}
    text = io.StringIO()
    print_table(refused, Console(file=text, width=100))
    assert "0.0 % of the images accepted" in text.getvalue()
    assert f"warning: {N} images not accepted: beyond the contacts that were taught" in text.getvalue()


def test_opencv_threads_are_restored(data: Path, model: Path) -> None:
    before = cv2.getNumThreads()
    evaluate(data, "val", model)
    assert cv2.getNumThreads() == before


def test_bad_inputs(data: Path, model: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError):
        evaluate(data, "test", model)
    with pytest.raises(ModelError):
        evaluate(data, "val", tmp_path / "none.safetensors")
    for path in (data / "val" / "processed_images").iterdir():
        cv2.imwrite(str(path), draw(CENTRE, (40, 40)))
    with pytest.raises(ImageError):
        evaluate(data, "val", model)


@pytest.mark.parametrize(
    ("shipped", "remedy"),
    [
        ("sim_gdn", "an image network sees one camera only: `touchcell train --data {data} --out NAME.safetensors`"),
        ("sim_shape", "`touchcell adapt --data {data}` brings it to this one, by ten labelled images or more"),
        ("sim_franka_tactip_1", "use `touchcell adapt` with the model that it came from"),
    ],
)
def test_images_of_another_size_are_refused_with_what_helps(data: Path, shipped: str, remedy: str) -> None:
    with pytest.raises(ImageError) as refused:
        evaluate(data, "val", MODELS / f"{shipped}.safetensors")
    assert refused.value.attribute == "size"
    assert refused.value.expected == (480, 640)
    assert refused.value.hint is not None
    assert refused.value.hint.startswith(f"{shipped} is for another camera or crop")
    assert refused.value.hint.endswith(remedy.format(data=data))
