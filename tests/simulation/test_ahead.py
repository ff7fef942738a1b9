"""What ``touchcell check`` remarks on an approach."""

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.ahead import remark_on_approach
from touchcell.simulation.closed_forms import Box
from touchcell.simulation.surfaces import Sphere, Surface

SURFACES = {"block": Surface(Box((0.1, 0.1, 0.02))), "ball": Surface(Sphere(0.04))}


@pytest.mark.parametrize(
    ("start_mm_deg", "remark"),
    [
        ((45.0, 45.0, 45.0, 180.0, 0.0, 0.0), None),
        ((45.0, 45.0, 38.0, 180.0, 0.0, 0.0), "the tip starts 2.0 mm deep in block"),
        ((45.0, 45.0, 120.0, 180.0, 0.0, 0.0), "the tip meets block after 80 mm only, and searches for 50 mm"),
        ((300.0, 0.0, 70.0, 180.0, 0.0, 0.0), "no surface lies ahead of the tip; it would pass block at 230 mm"),
        ((0.0, 35.0, 90.0, 180.0, 0.0, 0.0), "the tip meets ball at 36 deg to its face"),
    ],
)
def test_an_approach_that_comes_to_nothing_is_named(start_mm_deg: tuple[float, ...], remark: str | None) -> None:
    T_world_s = se3.from_euler_mm_deg(np.array(start_mm_deg))
    found = remark_on_approach(SURFACES, T_world_s, 0.020, 0.050)
    assert (found is None) if remark is None else (found is not None and found.startswith(remark)), found
