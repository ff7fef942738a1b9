"""What ``touchcell check`` remarks on an approach."""

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.ahead import remark_on_approach, remark_on_edge, start_near, way_along_edge
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
        ((48.0, 46.0, 45.0, 180.0, 0.0, 0.0), "the tip comes down at a corner; start along a side"),
    ],
)
def test_a_contact_that_is_not_with_an_edge_is_named(start_mm_deg: tuple[float, ...], remark: str | None) -> None:
    T_world_s = se3.from_euler_mm_deg(np.array(start_mm_deg))
    found = remark_on_edge([SURFACES["block"]], T_world_s, 0.020, 0.050)
    assert (found is None) if remark is None else (found is not None and found.startswith(remark)), found


@pytest.mark.parametrize("step_m", [0.004, -0.004])
def test_the_edge_of_a_block_leads_once_around_it(step_m: float) -> None:
    T_world_s = se3.from_euler_mm_deg(np.array([48.0, 0.0, 45.0, 180.0, 0.0, 0.0]))
    way = way_along_edge([SURFACES["block"]], T_world_s, 0.020, 0.050, 1.0, step_m)
    assert way is not None
    way = way[:, :3, 3]
    np.testing.assert_allclose([way.min(axis=0)[:2], way.max(axis=0)[:2]], [[-0.05, -0.05], [0.05, 0.05]], atol=5e-4)
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() == pytest.approx(0.4, abs=0.01)
    # The sensor looks down with x outwards: its y axis has the face to its left.
    assert np.sign(way[1, 1] - way[0, 1]) == -np.sign(step_m)


def test_no_edge_is_followed_where_none_is_met() -> None:
    T_world_s = se3.from_euler_mm_deg(np.array([300.0, 0.0, 45.0, 180.0, 0.0, 0.0]))
    assert way_along_edge([SURFACES["block"]], T_world_s, 0.020, 0.050, 1.0, 0.004) is None


def test_from_a_corner_a_start_along_a_side_is_advised_unless_it_is_not_allowed() -> None:
    surfaces = {"block": SURFACES["block"]}
    at_corner = se3.from_euler_mm_deg(np.array([48.0, 46.0, 45.0, 180.0, 0.0, 0.0]))
    found = start_near(surfaces, at_corner, 0.020, 0.050, on_edge=True)
    assert found is not None
    assert remark_on_edge(list(surfaces.values()), found, 0.020, 0.050) is None
    assert np.linalg.norm(found[:2, 3] - at_corner[:2, 3]) < 0.025
    assert start_near(surfaces, at_corner, 0.020, 0.050, on_edge=True, allowed=lambda T_world_s: False) is None
