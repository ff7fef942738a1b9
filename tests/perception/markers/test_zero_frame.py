from pathlib import Path

import numpy as np
import pytest

from tests.helpers.marker_samples import REST, SIZE
from tests.perception.models.test_model_file import make_model
from touchcell.cell.cli.calibrate import calibrate
from touchcell.errors import ConfigError, DataError
from touchcell.geometry.types import Array, ImageArray
from touchcell.paths import MODELS
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.zero_frame import find_change, lattice_turns, similarity
from touchcell.perception.models.camera_change import CameraChange, load_change
from touchcell.perception.models.model_file import Model
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.runtime.calibrated_estimator import CalibratedEstimator
from touchcell.perception.runtime.estimators import load_estimator
from touchcell.perception.runtime.inference import ContactModel
from touchcell.simulation.render import FrameRenderer

CORNER = np.array([105.0, 20.0])
CHANGE = CameraChange(zoom=0.97, turn_deg=2.0, centre_px=(226.0, 221.0), shift_px=(-5.0, 3.0))


def image(points: Array, seed: int = 0) -> ImageArray:
    jitter = np.random.default_rng(seed).normal(0.0, 0.3, points.shape)
    return FrameRenderer().processed(points + jitter + CORNER)


def seen_through(change: CameraChange, points: Array) -> Array:
    """Return the points of the changed camera for ``points`` of the training camera."""
    return (points - change.matrix[:, 2]) @ np.linalg.inv(change.matrix[:, :2]).T


def model_of(reference: ImageArray | None) -> Model:
    made = make_model(reference=False)
    preprocessing = Preprocessing(input_size=SIZE, output_size=(32, 32))
    header = made.header.model_copy(update={"preprocessing": preprocessing})
    return Model(header, made.tensors, reference)


def test_a_changed_camera_is_found_in_a_few_images_and_undone() -> None:
    frames = [image(seen_through(CHANGE, REST), seed) for seed in range(4)]
    found = find_change(model_of(None), frames, taught=[image(REST, seed) for seed in range(10, 13)])
    assert found.zoom == pytest.approx(CHANGE.zoom, abs=3e-4)
    assert found.turn_deg == pytest.approx(CHANGE.turn_deg, abs=0.05)
    np.testing.assert_allclose(found.points(seen_through(CHANGE, REST)), REST, atol=0.3)
    assert found.frames == 4
    assert found.rms_px < 0.3
    straightened = found.image(frames[0])
    assert set(np.unique(straightened)) == {0, 255}
    assert (straightened != image(REST, 0)).mean() < 0.03 < 0.1 < (frames[0] != image(REST, 0)).mean()


def test_the_models_own_image_is_enough() -> None:
    preprocessing = Preprocessing(input_size=SIZE, output_size=(128, 128))
    held = model_of(None)
    held = Model(held.header.model_copy(update={"preprocessing": preprocessing}), held.tensors, None)
    held = Model(held.header, held.tensors, preprocessing.reduce(image(REST)))
    found = find_change(held, [image(seen_through(CHANGE, REST), seed) for seed in range(4)])
    assert found.zoom == pytest.approx(CHANGE.zoom, abs=1e-3)
    np.testing.assert_allclose(found.points(seen_through(CHANGE, REST)), REST, atol=0.5)


def test_an_image_out_of_contact_takes_precedence_over_a_deformed_lattice() -> None:
    preprocessing = Preprocessing(input_size=SIZE, output_size=SIZE)
    header = model_of(None).header.model_copy(update={"preprocessing": preprocessing})
    pressed = {"lattice": (1.01 * REST).astype(np.float32)}
    assert find_change(Model(header, pressed), [image(REST)]).zoom == pytest.approx(1.01, abs=1e-3)
    held = find_change(Model(header, pressed, image(REST)), [image(REST)])
    assert held.zoom == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(held.shift_px, 0.0, atol=0.01)


def test_without_a_reference_the_error_names_the_option() -> None:
    with pytest.raises(TrainingError, match="--reference"):
        find_change(model_of(None), [image(REST)])
    with pytest.raises(TrainingError, match="no image"):
        find_change(model_of(None), [], taught=[image(REST)])


def test_another_tip_and_no_tip_are_refused() -> None:
    stretched = REST * np.array([1.06, 0.94])
    with pytest.raises(TrainingError, match=r"px off|no lattice"):
        find_change(model_of(None), [image(stretched)], taught=[image(REST)])
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2) * 21.0 + 15.0
    with pytest.raises(TrainingError, match="no lattice"):
        find_change(model_of(None), [image(grid)], taught=[image(REST)])


def test_two_changes_after_each_other_are_one() -> None:
    first = CameraChange(zoom=1.05, turn_deg=-4.0, centre_px=(100.0, 50.0), shift_px=(2.0, 1.0))
    points = np.random.default_rng(0).uniform(0, 400, (20, 2))
    np.testing.assert_allclose(CHANGE.after(first).points(points), CHANGE.points(first.points(points)), atol=1e-9)


def test_an_estimator_undoes_the_change() -> None:
    plain = ContactModel(model_of(None))
    through = CalibratedEstimator(ContactModel(model_of(None)), CHANGE)
    there, here = image(REST), image(seen_through(CHANGE, REST))
    np.testing.assert_array_equal(through.reduce(here), plain.reduce(CHANGE.image(here)))
    apart = np.abs(through.reduce(here).astype(float) - plain.reduce(there)).mean()
    assert apart < 0.3 * np.abs(plain.reduce(here).astype(float) - plain.reduce(there)).mean()
    np.testing.assert_allclose(through.predict(here).xi, through.predict_reduced(through.reduce(here)).xi)


def test_a_lattice_is_symmetric_under_rotation_by_60_degrees() -> None:
    for sixth, order in enumerate(lattice_turns(10)):
        assert sorted(order) == list(range(331))
        linear, off = similarity(REST[order], REST)
        assert off < 0.5
        assert np.degrees(np.angle(linear)) % 360 == pytest.approx((-60.0 * sixth) % 360, abs=0.2)


def test_calibration_files(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "sensor.yaml"
    CHANGE.save(path)
    assert load_change(path) == CHANGE
    for text in ("zoom: 0", "schema: 1\nzoom: .nan\nturn_deg: 0\ncentre_px: [0, 0]\nshift_px: [0, 0]", "["):
        path.write_text(text)
        with pytest.raises(ConfigError):
            load_change(path)
    with pytest.raises(ConfigError, match="touchcell calibrate"):
        load_change(tmp_path / "none.yaml")


def test_a_cell_s_own_sensor_takes_the_images(tmp_path: Path) -> None:
    model = MODELS / "sim_gdn.safetensors"
    out = tmp_path / "sensor.yaml"
    change = calibrate(model, out, cell=Path("configs/surface_follow_sim.yaml"), count=2)
    assert change.zoom == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(change.shift_px, 0.0, atol=0.2)
    assert load_change(out) == change
    assert isinstance(load_estimator(model, out), CalibratedEstimator)
    with pytest.raises(ConfigError, match="no sensor 'nobody'"):
        calibrate(model, out, cell=Path("configs/surface_follow_sim.yaml"), sensor="nobody")
    with pytest.raises(DataError, match="no PNG"):
        calibrate(model, out, frames=tmp_path)
