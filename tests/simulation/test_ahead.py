"""What ``touchcell check`` remarks on an approach."""

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.ahead import remark_on_approach, remark_on_edge, start_near
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


@pytest.mark.parametrize(
    "start_mm_deg",
    [
        (45.0, 45.0, 38.0, 180.0, 0.0, 0.0),
        (45.0, 45.0, 120.0, 180.0, 0.0, 0.0),
        (300.0, 0.0, 70.0, 180.0, 0.0, 0.0),
        (0.0, 35.0, 90.0, 180.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 180.0, 0.0, 0.0),
    ],
)
@pytest.mark.parametrize("on_edge", [False, True])
def test_a_start_is_found_from_which_an_approach_makes_contact(start_mm_deg: tuple[float, ...], on_edge: bool) -> None:
    T_world_s = se3.from_euler_mm_deg(np.array(start_mm_deg))
    found = start_near(SURFACES, T_world_s, 0.020, 0.050, on_edge=on_edge)
    assert found is not None
    assert remark_on_approach(SURFACES, found, 0.020, 0.050) is None
    if on_edge:
        assert remark_on_edge(list(SURFACES.values()), found, 0.020, 0.050) is None


def test_no_other_start_is_found_where_the_given_one_will_do() -> None:
    T_world_s = se3.from_euler_mm_deg(np.array([45.0, 45.0, 45.0, 180.0, 0.0, 0.0]))
    assert start_near(SURFACES, T_world_s, 0.020, 0.050) is None


@pytest.mark.parametrize(
    ("start_mm_deg", "remark"),
    [
        ((48.0, 0.0, 45.0, 180.0, 0.0, 0.0), None),
        ((30.0, 0.0, 45.0, 180.0, 0.0, 0.0), "the tip comes down 20 mm inside the nearest edge"),
        ((48.0, 0.0, 45.0, 180.0, 0.0, 90.0), "the tip comes down on an edge with its x axis turned by"),
    ],
)
def test_a_contact_that_is_not_with_an_edge_is_named(start_mm_deg: tuple[float, ...], remark: str | None) -> None:
    T_world_s = se3.from_euler_mm_deg(np.array(start_mm_deg))
    found = remark_on_edge([SURFACES["block"]], T_world_s, 0.020, 0.050)
    assert (found is None) if remark is None else (found is not None and found.startswith(remark)), found
