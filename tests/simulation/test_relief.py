"""What a tip feels of a shape besides its tangent plane."""

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.closed_forms import Box, Cylinder
from touchcell.simulation.mesh_surfaces import DifferenceConfig
from touchcell.simulation.meshes import primitives
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.relief import felt_relief
from touchcell.simulation.surfaces import Dome, Plane, Shape, Sphere, Surface
from touchcell.simulation.tip import Tip

TIP = Tip()
RADIUS_M = 0.020
PRESSED = se3.from_euler_mm_deg(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))


def felt(shape: Shape, x_mm: float = 0.0, y_mm: float = 0.0, z_mm: float = 17.0) -> Array | None:
    T_world_s = se3.from_euler_mm_deg(np.array([x_mm, y_mm, z_mm, 180.0, 0.0, 0.0]))
    return felt_relief(Surface(shape), T_world_s, 0.0, TIP.relief.directions, RADIUS_M)


def moved_px(relief: Array | None) -> Array:
    return np.linalg.norm(TIP.pixels(PRESSED, relief) - TIP.pixels(PRESSED), axis=1)


def test_a_plane_gives_the_calibrated_image_to_the_bit() -> None:
    assert felt(Plane()) is None
    assert np.array_equal(TIP.pixels(PRESSED, None), TIP.pixels(PRESSED))


def test_the_middle_of_a_large_face_is_a_plane() -> None:
    relief = felt(Box((0.2, 0.2, 0.02)), z_mm=37.0)
    assert relief is not None
    assert np.allclose(relief, 0.0, atol=1e-12)
    assert np.allclose(TIP.pixels(PRESSED, relief), TIP.pixels(PRESSED), atol=1e-9)


def test_a_dome_presses_less_and_a_hollow_more_the_further_from_the_middle() -> None:
    hollow = primitives.ball(0.026)
    inside = MeshShape(TriangleMesh(hollow.vertices, np.ascontiguousarray(hollow.faces[:, ::-1])), 0.5)
    less, more = felt(Dome(0.020), z_mm=37.0), felt(inside, z_mm=-9.0)
    assert less is not None
    assert more is not None
    assert less.max() <= 1e-12
    assert less.min() < -1e-3
    assert more.min() >= -1e-6
    assert more.max() > 1e-3


def test_a_flatter_dome_is_more_like_a_plane() -> None:
    moved = [moved_px(felt(Dome(r), z_mm=1e3 * r + 17.0)).max() for r in (0.02, 0.05, 0.2, 1.0)]
    assert moved == sorted(moved, reverse=True)
    assert moved[-1] < 1.0


def test_only_the_side_beyond_an_edge_changes() -> None:
    relief = felt(Box((0.2, 0.08, 0.02)), y_mm=40.0, z_mm=37.0)
    assert relief is not None
    # The sensor is turned over about x: its y axis points back onto the face.
    on_face = TIP.relief.directions[:, 1] > 0.05
    assert np.allclose(relief[on_face], 0.0, atol=1e-12)
    assert relief.min() == pytest.approx(-0.0027, abs=0.0004)


def test_the_image_of_an_edge_turns_with_the_edge() -> None:
    turned = se3.from_euler_mm_deg(np.array([40.0, 0.0, 37.0, 180.0, 0.0, -90.0]))
    straight = felt(Box((0.2, 0.08, 0.02)), y_mm=40.0, z_mm=37.0)
    other = felt_relief(Surface(Box((0.08, 0.2, 0.02))), turned, 0.0, TIP.relief.directions, RADIUS_M)
    assert straight is not None
    assert other is not None
    assert np.allclose(straight, other, atol=1e-9)


def test_a_pin_is_felt_where_it_is() -> None:
    moved = moved_px(felt(Cylinder(0.0015, 0.02), z_mm=37.0))
    assert moved.max() > 5.0


def test_out_of_contact_nothing_is_felt() -> None:
    assert felt(Sphere(0.05), z_mm=80.0) is None


@pytest.mark.parametrize("thickness_mm", [0.2, 1.0, 3.0])
def test_a_thin_wall_feels_as_a_thick_one_does(thickness_mm: float) -> None:
    thick, thin = (felt(Box((0.2, 0.2, 1e-3 * h)), z_mm=h + 17.0) for h in (20.0, thickness_mm))
    assert thick is not None
    assert thin is not None
    assert np.allclose(thin, thick, atol=1e-9)


def test_a_thin_bent_wall_feels_as_a_ball_does() -> None:
    outer, inner = primitives.ball(0.050), primitives.ball(0.049)
    shell = TriangleMesh(
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]).astype(np.int32),
    )
    solid = felt(Sphere(0.050), z_mm=67.0)
    hollow = felt(MeshShape(shell, 0.5), z_mm=67.0)
    assert solid is not None
    assert hollow is not None
    assert np.abs(hollow - solid).max() < 2e-4


@pytest.mark.parametrize("x_mm", [36.0, 40.0, 41.5])
@pytest.mark.parametrize("radius_mm", [37.5, 38.5])
def test_a_hollow_part_feels_as_a_solid_one_does_beside_its_walls(x_mm: float, radius_mm: float) -> None:
    """Of a shell open below, the inner walls are the nearest surface of much skin near the rim."""
    pytest.importorskip("manifold3d")
    disc = {"kind": "cylinder", "radius_mm": 40.0, "height_mm": 25.0}
    hollow = {"kind": "cylinder", "radius_mm": radius_mm, "height_mm": 22.5}
    shell = DifferenceConfig.model_validate({"kind": "difference", "parts": {"disc": disc, "hollow": hollow}}).shape()
    thin, thick = felt(shell, x_mm=x_mm, z_mm=42.0), felt(Cylinder(0.04, 0.025), x_mm=x_mm, z_mm=42.0)
    assert thin is not None
    assert thick is not None
    assert thin == pytest.approx(thick, abs=0.12e-3)
