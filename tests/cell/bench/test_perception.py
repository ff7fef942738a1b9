"""``touchcell bench perception`` measures every estimator in its own process."""

from __future__ import annotations

import json
import multiprocessing
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.tactile_samples import contacts, draw, write_split
from tests.perception.models.test_model_file import make_model
from tests.perception.runtime.test_inference import constant_model
from touchcell.cell.bench.perception import camera_frame, table, write_simulated
from touchcell.cell.bench.perception_runtimes import RUNTIMES, installed
from touchcell.cell.cli.exit_codes import EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.drivers.replay.dataset import read_split
from touchcell.perception.models.camera_frames import FRAME_SIZE, from_camera
from touchcell.perception.models.model_file import save_model
from touchcell.perception.models.preprocessing import Crop, Preprocessing
from touchcell.perception.networks.evaluate import evaluate
from touchcell.perception.runtime.inference import ContactModel
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.samples import contacts as simulated_contacts

PUBLIC = Preprocessing(input_size=(440, 445), output_size=(440, 445))


def test_without_data_the_shipped_model_is_run_on_simulated_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--", "--images", "12", "--frames", "4", "--runtimes", "onnxruntime"]
    assert main(["bench", "perception", "--out", str(tmp_path), *words]) == EXIT_OK
    text = capsys.readouterr().out
    assert text.startswith("12 simulated camera frames and the shipped model")
    assert (tmp_path / "perception.txt").read_text() in text
    (row,) = json.loads((tmp_path / "perception.json").read_text())["rows"]
    assert (row["estimator"], row["runtime"], row["all"]["n"]) == ("sim_gdn", "onnxruntime", 12)
    assert row["slip_free"]["n"] + row["slipping"]["n"] == 12
    assert row["all"]["mae"]["z_mm"] < 0.2
    turns = json.loads((tmp_path / "perception.json").read_text())["by_turns"]["sim_gdn"]
    assert 0.0 < turns["onnxruntime"]["median"] <= turns["onnxruntime"]["p99"]
    assert 40.0 < row["memory_mb"] <= row["peak_mb"] < 400.0
    assert 0.0 < row["latency_ms"]["cpu"]["median"] <= row["latency_ms"]["cpu"]["p99"]
    assert list(row["stages_ms"]) == ["preprocessing", "network", "Gaussian"]
    assert all(0.0 < stage["median"] <= stage["p99"] for stage in row["stages_ms"].values())
    assert 0.0 < row["start_cpu_s"] < 60.0
    assert json.loads((tmp_path / "perception.json").read_text())["bands"]["sim_gdn"]["all"]["n"] == 12
    for name in (
        "perception.png",
        "perception_reliability.png",
        "perception_reliability_sim_gdn.png",
        "perception_sim_gdn.png",
    ):
        assert (tmp_path / name).stat().st_size > 10_000


def test_figures_are_those_of_evaluate(tmp_path: Path) -> None:
    write_split(tmp_path / "data", "val", n=15, seed=6)
    model = tmp_path / "model.safetensors"
    save_model(constant_model("gdn", [0.0] * 12), model)
    words = ["--data", str(tmp_path / "data"), "--models", str(model), "--runtimes", "onnxruntime", "--frames", "3"]
    assert main(["bench", "perception", "--out", str(tmp_path / "out"), "--", *words]) == EXIT_OK
    (row,) = json.loads((tmp_path / "out" / "perception.json").read_text())["rows"]
    expected = evaluate(tmp_path / "data", "val", model)
    assert row["all"]["mae"] == pytest.approx(expected.mae)
    assert row["all"]["nll"] == pytest.approx(expected.nll)
    assert row["camera"]["n"] == 3
    assert row["all"]["coverage"] == expected.coverage


def compare(name: str) -> None:
    """Compare a runtime's outputs with those of ONNX Runtime."""
    for kind in ("gdn", "cnn"):
        base = make_model()
        outputs = [0.3] * (12 if kind == "gdn" else 6)
        model = base if kind == "gdn" else constant_model("cnn", outputs)
        images = [draw(contact) for contact in contacts(4, seed=3)]
        own, other = ContactModel(model), ContactModel(model, RUNTIMES[name](model))
        for image in images:
            expected, found = own.predict(image), other.predict(image)
            np.testing.assert_allclose(found.xi, expected.xi, atol=1e-6)
            np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-3)


@pytest.mark.parametrize("name", [name for name in RUNTIMES if name != "onnxruntime"])
def test_runtimes_compute_the_same(name: str) -> None:
    """In its own process: one in which OpenVINO 2026.4 has compiled a network dies of the next signal."""
    if name not in installed():
        pytest.skip(f"{name} is not installed")
    process = multiprocessing.get_context("spawn").Process(target=compare, args=(name,))
    process.start()
    process.join()
    assert process.exitcode == 0


def test_a_thresholded_image_survives_the_camera() -> None:
    (contact,) = simulated_contacts(1, seed=0)
    image = FrameRenderer(contact.disc_radius_px).processed(contact.pixels)
    frame = camera_frame(image, seed=1)
    assert (frame.shape, frame.dtype) == (FRAME_SIZE, np.uint8)
    back = from_camera(PUBLIC).reduce(frame)
    # Only pixels of the discs' edges change.
    assert (back != image).mean() < 0.03
    assert set(np.unique(back)) == {0, 255}
    assert camera_frame(frame, seed=2) is frame


def test_a_model_of_camera_frames_keeps_its_chain() -> None:
    taught = PUBLIC.model_copy(update={"input_size": FRAME_SIZE})
    assert from_camera(taught) is taught
    assert from_camera(PUBLIC).output_size == PUBLIC.output_size
    cropped = PUBLIC.model_copy(update={"crop": Crop(0, 2, 444, 440)})
    assert from_camera(cropped).crop == Crop(97, 22, 97 + 444, 20 + 440)


def test_simulated_split_has_the_public_layout(tmp_path: Path) -> None:
    write_simulated(tmp_path / "val", 5)
    split = read_split(tmp_path, "val")
    assert len(split.images) == 5
    assert next(split.read()).shape == FRAME_SIZE
    assert (split.contact_mm_deg[:, 2] > 0.3).all()


def test_table_omits_missing_figures() -> None:
    figures = dict.fromkeys(("z_mm", "alpha_deg", "beta_deg", "x_mm", "y_mm", "gamma_deg"), 0.5)
    scored = {"n": 3, "mae": figures, "nll": 1.0, "coverage": {"68": figures, "95": figures}}
    quantiles = {clock: {"median": 1.0, "p99": 2.0} for clock in ("wall", "cpu")}
    row = {
        "estimator": "a",
        "runtime": "own",
        "latency_ms": quantiles,
        "again_ms": quantiles,
        "stages_ms": {"network": {"median": 0.25, "p99": 0.5}},
        **dict.fromkeys(("start_s", "start_cpu_s", "memory_mb", "peak_mb", "apart_from_first_runtime"), 1.0),
        "training_s": None,
        "all": scored,
        "slip_free": scored,
        "slipping": {"n": 0},
        "camera": {"n": 0},
    }
    lines = table(
        [row, {**row, "estimator": "b", "stages_ms": {"matching": {"median": 0.75, "p99": 1.0}}}]
    ).splitlines()
    assert lines[-2].split() == ["a", "own", "0.25", "0.50", "-"]
    assert lines[-1].split() == ["b", "own", "-", "0.75", "1.00"]
    assert sum(line.startswith("  a ") for line in lines) == 2
