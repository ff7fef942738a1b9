"""Surfaces that are made: extrusions, superquadrics, height fields, and solids of solids."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchcell.errors import ConfigError
from touchcell.simulation.meshes.smoothing import Edges
from touchcell.simulation.scene import SceneConfig
from touchcell.simulation.surfaces import Shape

for library in ("trimesh", "manifold3d", "shapely", "mapbox_earcut"):
    pytest.importorskip(library)

MM = 1e-3
LENS = {"upper": -40, "lower": 40}


def shape_of(**section: Any) -> Shape:
    return SceneConfig.model_validate({"surfaces": {"it": section}}).surfaces["it"].shape()


def problems_of(**section: Any) -> list[ConfigError]:
    return list(SceneConfig.model_validate({"surfaces": {"it": section}}).problems())


def test_an_extrusion_has_walls_and_a_top() -> None:
    square = shape_of(kind="extrusion", outline_mm=[[0, 0], [40, 0], [40, 40], [0, 40]], height_mm=20)
    top = square.nearest(np.array([0.02, 0.02, 0.025]))
    assert top.distance_m == pytest.approx(5 * MM)
    assert np.allclose(top.normal, [0.0, 0.0, 1.0])
    wall = square.nearest(np.array([0.05, 0.02, 0.01]))
    assert wall.distance_m == pytest.approx(10 * MM)
    assert np.allclose(wall.normal, [1.0, 0.0, 0.0])


def test_a_superquadric_with_exponents_of_one_is_an_ellipsoid() -> None:
    ball = shape_of(kind="superquadric", radii_mm=[40, 40, 40])
    found = ball.nearest(np.array([0.0, 0.03, 0.04]))
    assert found.distance_m == pytest.approx(10 * MM, abs=0.02 * MM)
    assert found.curvatures_per_m == pytest.approx((25.0, 25.0), abs=0.2)


def test_a_bowl_is_a_cylinder_without_a_ball() -> None:
    bowl = shape_of(
        kind="difference",
        parts={
            "block": {"kind": "cylinder", "radius_mm": 60, "height_mm": 40},
            "hollow": {"kind": "sphere", "radius_mm": 50, "pose_mm_deg": [0, 0, 70, 0, 0, 0]},
        },
    )
    inside = bowl.nearest(np.array([0.005, 0.0, 0.037]))
    assert inside.distance_m == pytest.approx(50 * MM - np.hypot(5 * MM, 33 * MM), abs=0.02 * MM)
    assert inside.curvatures_per_m == pytest.approx((-20.0, -20.0), abs=0.5)


def test_union_and_intersection_are_those_of_the_solids() -> None:
    parts = {
        "one": {"kind": "box", "size_mm": [40, 40, 20]},
        "two": {"kind": "box", "size_mm": [20, 20, 40]},
    }
    p = np.array([0.0, 0.0, 0.045])
    assert shape_of(kind="union", parts=parts).nearest(p).distance_m == pytest.approx(5 * MM)
    assert shape_of(kind="intersection", parts=parts).nearest(p).distance_m == pytest.approx(25 * MM)


def test_parts_without_a_volume_are_refused_by_name() -> None:
    (problem,) = problems_of(
        kind="union", parts={"block": {"kind": "box", "size_mm": [40, 40, 20]}, "floor": {"kind": "plane"}}
    )
    assert problem.key == "surfaces.it.parts.floor"
    assert "volume" in problem.reason


def test_an_outline_that_crosses_itself_is_refused() -> None:
    (problem,) = problems_of(kind="extrusion", outline_mm=[[0, 0], [40, 40], [40, 0], [0, 40]], height_mm=20)
    assert problem.key == "surfaces.it.outline_mm"


def test_a_height_field_is_read_from_a_table(tmp_path: Path) -> None:
    side = np.linspace(-40.0, 40.0, 81)
    np.savetxt(tmp_path / "hill.csv", 10.0 - 0.005 * np.add.outer(side**2, side**2), delimiter=",")
    hill = shape_of(kind="height_field", file=str(tmp_path / "hill.csv"), spacing_mm=1.0)
    found = hill.nearest(np.array([0.0, 0.0, 0.03]))
    assert found.distance_m == pytest.approx(20 * MM, abs=0.02 * MM)
    assert found.curvatures_per_m == pytest.approx((10.0, 10.0), abs=0.2)
    (tmp_path / "words.csv").write_text("a, b\n")
    (problem,) = problems_of(kind="height_field", file=str(tmp_path / "words.csv"), spacing_mm=1.0)
    assert problem.key == "surfaces.it.file"


def test_a_solid_of_solids_is_closed() -> None:
    shape = shape_of(
        kind="difference",
        parts={
            "block": {"kind": "box", "size_mm": [60, 60, 20]},
            "hole": {"kind": "cylinder", "radius_mm": 15, "height_mm": 60, "pose_mm_deg": [0, 0, -10, 0, 0, 0]},
        },
    )
    edges = Edges.of(shape.drawn().faces)  # type: ignore[attr-defined]
    assert (edges.open_count, edges.crowded_count, edges.flipped_count) == (0, 0, 0)


def test_a_rim_lies_on_the_surfaces_of_its_parts_and_has_their_normals_and_curvature() -> None:
    halves = {side: {"kind": "sphere", "radius_mm": 60, "pose_mm_deg": [0, 0, z, 0, 0, 0]} for side, z in LENS.items()}
    lens = shape_of(kind="intersection", parts=halves)
    rim_mm = math.sqrt(60.0**2 - 40.0**2)
    starts = lens.edges.starts  # type: ignore[attr-defined]
    assert np.allclose(1e3 * np.linalg.norm(starts[:, :2], axis=1), rim_mm, atol=2e-4)
    assert np.allclose(starts[:, 2], 0.0, atol=1e-6)
    for angle in np.linspace(0.0, 6.0, 13):
        # 0.3 mm beside the rim, 4 mm above the upper face.
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        outward = np.array([0.0, 0.0, 40e-3]) + (rim_mm - 0.3) * MM * way
        outward /= np.linalg.norm(outward)
        found = lens.nearest(np.array([0.0, 0.0, -40e-3]) + 64e-3 * outward)
        assert found.distance_m == pytest.approx(4e-3, abs=1e-6)
        assert math.degrees(math.acos(min(1.0, float(found.normal @ outward)))) < 0.05
        assert found.curvatures_per_m == pytest.approx((1 / 60e-3, 1 / 60e-3), rel=0.02)


def test_parts_that_share_planes_of_symmetry_can_be_parts_again() -> None:
    ball = {"kind": "sphere", "radius_mm": 40}
    post = {"kind": "cylinder", "radius_mm": 20, "height_mm": 80}
    cut = {"kind": "box", "size_mm": [100, 100, 50], "pose_mm_deg": [0, 0, 20, 0, 0, 0]}
    both = {"kind": "union", "parts": {"ball": ball, "post": post}}
    edges = Edges.of(shape_of(kind="difference", parts={"both": both, "cut": cut}).drawn().faces)  # type: ignore[attr-defined]
    assert (edges.open_count, edges.crowded_count, edges.flipped_count) == (0, 0, 0)


def test_parts_that_only_touch_have_nothing_in_common() -> None:
    low = {"kind": "box", "size_mm": [40, 80, 20]}
    high = {"kind": "box", "size_mm": [60, 60, 60], "pose_mm_deg": [0, 0, 20, 0, 0, 0]}
    (problem,) = problems_of(kind="intersection", parts={"low": low, "high": high})
    assert (problem.key, problem.reason) == ("surfaces.it.parts", "the intersection of its parts is empty")
