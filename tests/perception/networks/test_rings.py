"""The rings of a lattice are counted in images, of which some markers are missing and some discs are none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import Discs, lattice, rings_of
from touchcell.perception.networks.marker_learning import find_rings


@given(st.integers(1, 20))
def test_the_number_of_markers_tells_the_rings(rings: int) -> None:
    assert rings_of(len(lattice(rings))) == rings


@pytest.mark.parametrize("rings", [5, 7, 9, 10, 11])
def test_rings_are_counted_beside_dust_and_missing_pins(rings: int) -> None:
    rng = np.random.default_rng(rings)
    frames = []
    for deformed in (0.0, 0.5, 1.5):
        flat = 20.0 * lattice(rings) + 300.0
        centres = flat + deformed * rng.normal(0.0, 2.0, flat.shape)
        centres = centres[rng.random(len(centres)) > 0.03]
        dust = rng.uniform(centres.min(), centres.max(), (3, 2))
        frames.append(Discs(np.concatenate([centres, dust]), np.ones(len(centres) + 3)))
    assert find_rings(frames) == rings


def test_dots_at_random_are_no_lattice() -> None:
    centres = np.random.default_rng(0).uniform(0.0, 400.0, (331, 2))
    with pytest.raises(TrainingError, match="no image shows a lattice"):
        find_rings([Discs(centres, np.ones(331))])
