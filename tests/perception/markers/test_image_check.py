"""An image network's check: what is not touch is refused, a worn tip is kept and estimated as well as a new one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from touchcell.cell.bench.perception_changes import CHANGES, FrameChange
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.paths import MODELS
from touchcell.perception import kernels
from touchcell.perception.markers.image_check import ImageCheck
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.model_file import load_model
from touchcell.perception.networks.image_check import learn_image_check
from touchcell.perception.runtime.inference import ContactModel
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.samples import Variation, contacts

STILL = Variation(0, 0, 0, 0, 0, 0)
FRAMES = 12


@pytest.fixture(scope="module")
def model() -> ContactModel:
    return ContactModel(load_model(MODELS / "sim_gdn.safetensors"))


@pytest.fixture(scope="module")
def seen() -> list[tuple[ImageArray, Array]]:
    """Frames of the tip in the middle of the simulated family, with their contacts in mm and degrees."""
    renderer = FrameRenderer(seed=3)
    drawn = contacts(FRAMES, 21, depth_mm=(1.0, 5.0), variation=STILL)
    return [(renderer.raw(each.pixels, i), se3.to_euler_mm_deg(each.T_f_s)) for i, each in enumerate(drawn)]


def _changed(change: FrameChange, seen: list[tuple[ImageArray, Array]]) -> Iterator[tuple[ImageArray, Array]]:
    for i, (frame, contact) in enumerate(seen):
        yield change.apply(frame, seen[(i + FRAMES // 3) % FRAMES][0], np.random.default_rng((7, i))), contact


@pytest.mark.parametrize("change", [each for each in CHANGES if each.wanted == "refuse"], ids=lambda each: each.name)
def test_what_does_not_show_the_contact_is_refused_with_a_reason(
    change: FrameChange, model: ContactModel, seen: list[tuple[ImageArray, Array]]
) -> None:
    predictions = [model.predict(frame) for frame, _ in _changed(change, seen)]
    # Sensors of the simulated family differ by what looks like a zoom by up to 3 %.
    assert sum(each.in_range for each in predictions) <= (3 if "zoom" in change.name else 0)
    assert all(each.refusal for each in predictions if not each.in_range)


@pytest.mark.parametrize(
    "change",
    [each for each in CHANGES if each.wanted == "keep"],
    ids=lambda each: each.name,
)
def test_light_noise_dust_and_dead_pins_are_kept_and_estimated_well(
    change: FrameChange, model: ContactModel, seen: list[tuple[ImageArray, Array]]
) -> None:
    errors = []
    for frame, contact in _changed(change, seen):
        prediction = model.predict(frame)
        assert prediction.in_range, prediction.refusal
        errors.append(np.abs(prediction.pose_mm_deg - contact))
    z, tilt = np.mean(errors, axis=0)[2], np.mean(errors, axis=0)[3:5].mean()
    assert z < 0.25
    assert tilt < 1.5


def test_compiled_and_plain_kernels_find_and_measure_the_same(
    monkeypatch: pytest.MonkeyPatch, model: ContactModel, seen: list[tuple[ImageArray, Array]]
) -> None:
    stored = load_model(MODELS / "sim_gdn.safetensors")
    architecture = stored.header.architecture
    assert isinstance(architecture, Architecture)
    assert architecture.check is not None
    check = ImageCheck(architecture.check, stored.tensors, stored.header.preprocessing)
    image = model.reduce(seen[0][0]).copy()
    image[40:60, 40:60] = 0
    mean = model.infer(image)[:6]
    compiled = check.find(image, mean)
    measured = check.measure(compiled)
    monkeypatch.setattr(kernels, "_FOUND", None)
    plain = check.find(image, mean)
    assert np.array_equal(plain.seen, compiled.seen)
    assert plain.off == pytest.approx(compiled.off, abs=1e-3)
    assert plain.light == pytest.approx(compiled.light)
    assert check.measure(plain) == pytest.approx(measured, abs=1e-3)


def test_nothing_is_learned_from_images_without_markers(model: ContactModel) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (220, 128, 128)).astype(np.uint8)

    def means_of(images: ImageArray) -> np.ndarray:
        return np.zeros((len(images), 6), np.float32)

    assert learn_image_check(noise, means_of, model.header.preprocessing) is None
    assert learn_image_check(noise[:10], means_of, model.header.preprocessing) is None
