from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.tactile_samples import CENTRE, contacts, draw, preprocessing
from tests.perception.models.test_model_file import make_model
from touchcell.perception.errors import ImageError
from touchcell.perception.models.model_file import Model
from touchcell.perception.runtime.contact_gate import ContactGate

REST = CENTRE - [0.0, 0.0, 2.75, 0.0, 0.0, 0.0]


def seen(contact: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a preprocessed image with the noise of a camera."""
    image = draw(contact).astype(float) + rng.normal(0.0, 6.0, (44, 48))
    return preprocessing().reduce(np.clip(image, 0, 255).astype(np.uint8))


@pytest.fixture
def gate() -> ContactGate:
    rng = np.random.default_rng(1)
    return ContactGate.from_frames([seen(REST, rng) for _ in range(10)])


def test_rest_is_no_contact_and_every_contact_is(gate: ContactGate) -> None:
    rng = np.random.default_rng(2)
    assert not any(gate.update(seen(REST, rng)) for _ in range(200))
    for contact in contacts(100, seed=3):
        gate.in_contact = False
        assert gate.update(seen(contact, rng))


def test_hysteresis() -> None:
    reference = np.zeros((16, 16), np.uint8)
    gate = ContactGate(reference, enter=0.5, leave=0.25)
    levels = [100, 130, 100, 70, 60, 100, 130]
    assert [gate.update(np.full((16, 16), level, np.uint8)) for level in levels] == [
        False,
        True,
        True,
        True,
        False,
        False,
        True,
    ]
    assert gate.score == pytest.approx(130 / 255)


def test_a_change_in_an_eighth_of_the_image_counts_whole() -> None:
    gate = ContactGate(np.zeros((64, 64), np.uint8))
    touched = np.zeros((64, 64), np.uint8)
    touched[8:16, :] = 51
    assert gate.compare(touched) == pytest.approx(0.2)
    assert gate.compare(np.zeros((64, 64), np.uint8)) == 0.0
    # Sides that are not a multiple of the blocks are compared whole too.
    gate = ContactGate(np.zeros((13, 11), np.uint8))
    assert gate.compare(np.full((13, 11), 51, np.uint8)) == pytest.approx(0.2)


def test_noiseless_frames_still_need_a_change() -> None:
    gate = ContactGate.from_frames([np.full((16, 16), 80, np.uint8)] * 2)
    assert not gate.update(np.full((16, 16), 81, np.uint8))
    assert gate.update(np.full((16, 16), 90, np.uint8))


def test_bad_inputs(gate: ContactGate) -> None:
    with pytest.raises(ImageError):
        ContactGate(np.zeros((16, 16), np.float32))
    with pytest.raises(ImageError):
        ContactGate(np.zeros((4, 4), np.uint8))
    with pytest.raises(ImageError):
        gate.update(np.zeros((16, 16), np.uint8))
    with pytest.raises(ImageError):
        gate.update(np.zeros((32, 32), np.float32))
    with pytest.raises(ImageError):
        ContactGate.from_frames([np.zeros((16, 16), np.uint8)])
    with pytest.raises(ImageError):
        ContactGate.from_frames([np.zeros((16, 16), np.uint8), np.zeros((32, 32), np.uint8)])
    for enter, leave in ((0.1, 0.2), (0.1, 0.0), (1.5, 0.1), (float("nan"), 0.1)):
        with pytest.raises(ValueError, match="leave"):
            ContactGate(np.zeros((16, 16), np.uint8), enter=enter, leave=leave)


def test_reference_of_a_model_file() -> None:
    model: Model = make_model()
    assert model.reference is not None
    assert not ContactGate(model.reference).update(model.reference)
