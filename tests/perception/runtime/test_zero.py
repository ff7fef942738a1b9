from __future__ import annotations

import cv2
import numpy as np
import pytest

from touchcell.geometry.types import ImageArray
from touchcell.paths import MODELS
from touchcell.perception.contact_poses import random_poses
from touchcell.perception.errors import CameraError
from touchcell.perception.models.model_file import Model, load_model
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.estimators import calibrated
from touchcell.perception.runtime.zero import Zeroed, ZeroFrame
from touchcell.simulation.contact import ContactLaw, contact_at
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.tip import Tip, TipParameters

ENTER, LEAVE = 0.04, 0.025


@pytest.fixture(scope="module")
def shipped() -> Model:
    return load_model(MODELS / "sim_gdn.safetensors")


@pytest.fixture(scope="module")
def rest() -> ImageArray:
    tip = Tip(TipParameters())
    return FrameRenderer(seed=3).raw(tip.project(tip.rest_positions))


def _warped(frame: ImageArray, zoom: float, turn_deg: float, shift_px: tuple[float, float]) -> ImageArray:
    matrix = cv2.getRotationMatrix2D((331.0, 241.5), turn_deg, zoom)
    matrix[:, 2] += shift_px
    return np.asarray(cv2.warpAffine(frame, matrix, (640, 480), borderValue=(60.0,)), dtype=np.uint8)


def _zeroed(model: Model, frame: ImageArray) -> Zeroed:
    assert model.reference is not None
    gate = ContactGate(model.reference, enter=ENTER, leave=LEAVE)
    return ZeroFrame("tip", model, None, enter=ENTER, leave=LEAVE)(frame, calibrated(model), gate)


def test_the_models_own_camera_changes_nothing(shipped: Model, rest: ImageArray) -> None:
    assert shipped.reference is not None
    estimator, gate = calibrated(shipped), ContactGate(shipped.reference)
    zeroed = ZeroFrame("tip", shipped, None, enter=ENTER, leave=LEAVE)(rest, estimator, gate)
    assert zeroed.change is None
    assert zeroed.estimator is estimator
    assert zeroed.gate is gate


@pytest.mark.parametrize(
    ("zoom", "turn_deg", "shift_px"),
    [(1.05, 0.0, (0.0, 0.0)), (1.0, 5.0, (0.0, 0.0)), (1.0, 0.0, (10.0, 0.0)), (0.97, -2.0, (4.0, -6.0))],
)
def test_small_change_is_undone_and_the_gate_is_zeroed_again(
    shipped: Model, rest: ImageArray, zoom: float, turn_deg: float, shift_px: tuple[float, float]
) -> None:
    zeroed = _zeroed(shipped, _warped(rest, zoom, turn_deg, shift_px))
    assert zeroed.change is not None
    assert not zeroed.gate.update(zeroed.estimator.reduce(_warped(rest, zoom, turn_deg, shift_px)))
    tip, renderer = Tip(TipParameters()), FrameRenderer(seed=5)
    errors = []
    for i, pose in enumerate(random_poses(12, np.random.default_rng(1), (2.0, 4.0))):
        contact = contact_at(pose, ContactLaw())
        frame = renderer.raw(tip.pixels(contact.T_f_s[None])[0], i)
        upright = calibrated(shipped).predict(frame)
        changed = zeroed.estimator.predict(_warped(frame, zoom, turn_deg, shift_px))
        assert zeroed.gate.update(zeroed.estimator.reduce(_warped(frame, zoom, turn_deg, shift_px)))
        errors.append(np.abs(changed.pose_mm_deg - upright.pose_mm_deg))
    z, tilt = np.mean(errors, axis=0)[2], np.mean(errors, axis=0)[3:5].max()
    assert z < 0.15
    assert tilt < 2.0


@pytest.mark.parametrize(
    ("zoom", "turn_deg", "shift_px", "what"),
    [(1.1, 0.0, (0.0, 0.0), "zoomed"), (1.0, 15.0, (0.0, 0.0), "turned"), (1.0, 0.0, (30.0, 0.0), "shifted")],
)
def test_large_change_is_refused(
    shipped: Model, rest: ImageArray, zoom: float, turn_deg: float, shift_px: tuple[float, float], what: str
) -> None:
    with pytest.raises(CameraError, match=what) as caught:
        _zeroed(shipped, _warped(rest, zoom, turn_deg, shift_px))
    assert caught.value.sensor == "tip"


def test_upside_down_frame_of_a_tip_beside_the_image_centre_is_refused(shipped: Model, rest: ImageArray) -> None:
    with pytest.raises(CameraError):
        _zeroed(shipped, np.ascontiguousarray(rest[::-1, ::-1]))


def test_other_lattice_and_no_lattice_are_refused(shipped: Model, rest: ImageArray) -> None:
    tip = Tip(TipParameters(rings=7))
    for frame in (FrameRenderer(seed=3).raw(tip.project(tip.rest_positions)), np.zeros_like(rest)):
        with pytest.raises(CameraError):
            _zeroed(shipped, frame)
