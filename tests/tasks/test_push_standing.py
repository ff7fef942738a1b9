"""A push knows when what it touches no longer stands where it stood."""

from __future__ import annotations

import math

import numpy as np
import pytest

from touchcell.geometry.types import Array
from touchcell.tasks.push_standing import Standing

FRAME_S = 0.03


def pose(x_m: float) -> Array:
    """Return a sensor that looks along the base's x axis, its own x axis down."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T[:3, 3] = x_m, 0.0, 0.05
    return T


def contact(lean_deg: float) -> Array:
    """Return the contact with a side that leans away from the sensor."""
    lean = math.radians(lean_deg)
    T = np.eye(4)
    T[:3, :3] = np.array(
        [[math.cos(lean), 0.0, math.sin(lean)], [0.0, 1.0, 0.0], [-math.sin(lean), 0.0, math.cos(lean)]]
    )
    T[:3, 3] = -0.002 * T[:3, 2]
    return T


def test_an_object_that_leans_farther_than_models_misread_is_told() -> None:
    standing = Standing("sensor")
    standing.begin_approach()
    # A side that is not upright, or a sensor that is not mounted straight.
    assert not standing.changed(FRAME_S, pose(0.0), contact(4.0))
    assert not any(standing.changed(FRAME_S, pose(0.0), contact(4.0 + 1.8 * (-1) ** i)) for i in range(20))
    told = [standing.changed(FRAME_S, pose(0.0), contact(4.0 + lean)) for lean in np.arange(0.0, 15.0, 1.0)]
    assert not any(told[:7])
    assert told[-1].startswith("what sensor touches leans by")


def test_a_single_frame_does_not_make_an_object_topple() -> None:
    standing = Standing("sensor")
    standing.begin_approach()
    leans = [0.0, 20.0, 20.0, 0.0, 20.0, 20.0, 0.0]
    assert not any(standing.changed(FRAME_S, pose(0.0), contact(lean)) for lean in leans)


@pytest.mark.parametrize(("farther_mm", "gone"), [(12.0, False), (-30.0, False), (58.0, True)])
def test_an_object_that_is_touched_again_far_beyond_where_it_was_lost_has_fallen(farther_mm: float, gone: bool) -> None:
    standing = Standing("sensor")
    standing.begin_approach()
    assert not standing.changed(FRAME_S, pose(0.1), contact(0.0))
    standing.begin_approach()
    told = standing.changed(FRAME_S, pose(0.1 + 1e-3 * farther_mm), contact(0.0))
    assert ("has fallen" in told) == gone


def test_an_object_that_was_let_go_may_be_touched_elsewhere() -> None:
    standing = Standing("sensor")
    standing.begin_approach()
    assert not standing.changed(FRAME_S, pose(0.1), contact(0.0))
    standing.let_go()
    standing.begin_approach()
    assert not standing.changed(FRAME_S, pose(0.2), contact(0.0))
