"""Sigmas by depth and slip."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.cell.bench.perception_bands import band_lines, bands, summaries
from touchcell.perception.models.labels import XI_UNITS, xi_from_contact
from touchcell.perception.networks.scores import Scores


@pytest.fixture
def scores() -> Scores:
    """Deep contacts that do not slip, with sigmas that are half of the errors, and shallow ones that do."""
    rng = np.random.default_rng(0)
    contact = np.zeros((400, 6))
    contact[:, 2] = np.where(np.arange(400) < 200, 5.0, 1.0)
    contact[200:, 0] = 3.0
    sigma = np.array([0.1, 0.1, 0.05, 0.2, 0.2, 0.3]) * XI_UNITS
    spread = np.where(np.arange(400) < 200, 2.0, 1.0)[:, None] * sigma
    xi = xi_from_contact(contact) + rng.normal(0.0, 1.0, (400, 6)) * spread
    return Scores(contact, xi, np.tile(np.diag(sigma**2), (400, 1, 1)), np.ones(400, dtype=bool))


def test_each_depth_is_judged_with_and_without_slip(scores: Scores) -> None:
    found = bands(scores)
    assert {name: len(each) for name, each in found.items()} == {
        "all": 400,
        "no slip": 200,
        "slip": 200,
        "z 0 to 1.5 mm, slip": 200,
        "z > 4.5 mm, no slip": 200,
    }
    rows = summaries(scores)
    assert rows["z > 4.5 mm, no slip"]["nees"] == pytest.approx(24.0, rel=0.1)
    assert rows["z 0 to 1.5 mm, slip"]["nees"] == pytest.approx(6.0, rel=0.1)
    assert rows["z 0 to 1.5 mm, slip"]["coverage"]["95"]["z_mm"] == pytest.approx(0.95, abs=0.04)


def test_the_table_has_a_line_for_each(scores: Scores) -> None:
    rows = summaries(scores)
    lines = list(band_lines("model", rows))
    assert [line[:22].strip() for line in lines[2:]] == list(rows)
