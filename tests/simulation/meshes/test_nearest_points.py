"""Nearest points of meshes and closed forms against surfaces whose geometry is known."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.geometry.types import Array
from touchcell.simulation.closed_forms import Box, Cylinder, Saddle
from touchcell.simulation.meshes import _plain_mesh, primitives
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.smoothing import Edges, TriangleMesh, smooth
from touchcell.simulation.shape_drawing import drawn_shape
from touchcell.simulation.surfaces import Ramp, Shape, Sphere

CREASE = math.radians(30.0)
MM = 1e-3


def mesh_of(shape: Callable[[Array], float], side: Array) -> TriangleMesh:
    heights = np.array([[shape(np.array([x, y])) for x in side] for y in side])
    return primitives.height_field(heights, float(side[1] - side[0]))


def angle_deg(a: Array, b: Array) -> float:
    return math.degrees(math.acos(min(1.0, float(a @ b))))


def around(n: int, inner_m: float, outer_m: float) -> Array:
    rng = np.random.default_rng(1)
    way = rng.normal(size=(n, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return way * rng.uniform(inner_m, outer_m, (n, 1))


@pytest.mark.parametrize("outwards", [1, -1])
def test_a_meshed_ball_and_a_meshed_hollow_are_as_round_as_the_sphere(outwards: int) -> None:
    ball = primitives.ball(0.05, rows=33, sections=64)
    shape = MeshShape(TriangleMesh(ball.vertices, np.ascontiguousarray(ball.faces[:, ::outwards])), CREASE)
    for p in around(200, 0.030, 0.070):
        true = Sphere(0.05).nearest(p)
        found = shape.nearest(p)
        assert outwards * found.distance_m == pytest.approx(true.distance_m, abs=0.02 * MM)
        assert angle_deg(outwards * found.normal, true.normal) < 0.5
        assert np.linalg.norm(found.point - true.point) < 0.02 * MM
        assert found.curvatures_per_m == pytest.approx((outwards * 20.0, outwards * 20.0), abs=0.2)


def test_a_meshed_saddle_agrees_with_its_closed_form() -> None:
    saddle = Saddle(0.10, 0.08)
    side = np.linspace(-0.06, 0.06, 121)
    shape = MeshShape(mesh_of(lambda q: 0.5 * (q[0] ** 2 / 0.10 - q[1] ** 2 / 0.08), side), CREASE)
    rng = np.random.default_rng(2)
    for x, y in rng.uniform(-0.035, 0.035, (200, 2)):
        foot = np.array([x, y, 0.5 * (x * x / 0.10 - y * y / 0.08)])
        p = foot + 0.017 * saddle.nearest(foot).normal
        true, found = saddle.nearest(p), shape.nearest(p)
        assert found.distance_m == pytest.approx(true.distance_m, abs=0.02 * MM)
        assert angle_deg(found.normal, true.normal) < 0.5
        assert found.curvatures_per_m is not None
        assert true.curvatures_per_m is not None
        assert found.curvatures_per_m == pytest.approx(true.curvatures_per_m, abs=0.2)


def test_the_saddle_meets_the_conditions_of_a_nearest_point() -> None:
    saddle = Saddle(0.10, 0.08)
    rng = np.random.default_rng(3)
    for p in rng.uniform(-0.04, 0.04, (100, 3)):
        found = saddle.nearest(p)
        x, y, z = found.point
        assert z == pytest.approx(0.5 * (x * x / 0.10 - y * y / 0.08), abs=1e-9)
        assert np.allclose(p - found.point, found.distance_m * found.normal, atol=1e-8)


@pytest.mark.parametrize("shape", [Box((0.06, 0.04, 0.03)), Cylinder(0.03, 0.05)], ids=["box", "cylinder"])
def test_box_and_cylinder_agree_with_their_meshes(shape: Box | Cylinder) -> None:
    mesh = MeshShape(shape.drawn(), CREASE)
    rng = np.random.default_rng(4)
    for p in rng.uniform([-0.06, -0.06, -0.04], [0.06, 0.06, 0.09], (300, 3)):
        true, found = shape.nearest(p), mesh.nearest(p)
        assert found.distance_m == pytest.approx(true.distance_m, abs=0.02 * MM)
        if abs(true.distance_m) > 1e-3 and true.distance_m > 0.0:
            assert angle_deg(found.normal, true.normal) < 0.5


@pytest.mark.parametrize("shape", [Sphere(0.05), Ramp(0.10, 0.4), Cylinder(0.03, 0.05), Saddle(0.10, 0.08)])
def test_curvature_is_how_the_normal_turns(shape: Shape) -> None:
    p = np.array([0.02, 0.01, 0.06])
    found = shape.nearest(p)
    assert found.curvatures_per_m is not None
    away = found.point + 1e-3 * found.normal
    h = 1e-6
    turned = np.stack(
        [(shape.nearest(away + h * e).normal - shape.nearest(away - h * e).normal) / (2.0 * h) for e in np.eye(3)]
    )
    # At distance d from the surface a curvature k appears as k / (1 + k d).
    eigenvalues = sorted(np.linalg.eigvalsh(0.5 * (turned + turned.T)), key=abs)[1:]
    expected = sorted((k / (1.0 + k * 1e-3) for k in found.curvatures_per_m), key=abs)
    assert sorted(eigenvalues) == pytest.approx(sorted(expected), abs=0.05)


def test_compiled_and_plain_search_agree() -> None:
    mesh = primitives.superquadric(np.array([0.04, 0.03, 0.02]), 0.8, 1.3, rows=17, sections=32)
    made = smooth(mesh, CREASE)
    arguments = [
        np.ascontiguousarray(each)
        for each in (
            mesh.vertices,
            mesh.faces,
            made.normals,
            made.bends,
            made.neighbours,
            made.edge_normals,
            made.vertex_normals,
        )
    ]
    plain, shape = _plain_mesh.Tree(*arguments), MeshShape(mesh, CREASE)
    points = around(60, 0.01, 0.08)
    assert np.allclose(plain.distances(points), shape.distances(points), atol=1e-12)
    for p in points:
        if shape.distances(p[None])[0] > 0.0:
            assert plain.nearest(*p)[0] == pytest.approx(shape.nearest(p).distance_m, abs=0.5 * MM)


@settings(deadline=None, max_examples=60)
@given(st.tuples(*[st.floats(-0.1, 0.1)] * 3), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_distances_change_no_faster_than_the_point_moves(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    shape = MeshShape(primitives.box(np.array([0.05, 0.04, 0.03])), CREASE)
    p, q = np.array(a), np.array(b)
    assert abs(shape.nearest(p).distance_m - shape.nearest(q).distance_m) <= np.linalg.norm(p - q) + 1e-9


def test_a_point_that_is_not_finite_is_refused() -> None:
    shape = MeshShape(primitives.box(np.array([0.05, 0.04, 0.03])), CREASE)
    with pytest.raises(ValueError, match="not finite"):
        shape.nearest(np.array([0.0, np.nan, 0.0]))


def test_without_smoothing_facets_stay_flat() -> None:
    ball = primitives.ball(0.05, rows=9, sections=16)
    shape = MeshShape(ball, 0.0)
    normals = ball.face_normals()
    centre = ball.vertices[ball.faces[40]].mean(axis=0)
    found = shape.nearest(1.2 * centre)
    assert angle_deg(found.normal, normals[40] / np.linalg.norm(normals[40])) < 0.1


def test_primitives_are_closed_and_have_their_outsides_out() -> None:
    for mesh in (
        primitives.ball(0.02),
        primitives.box(np.array([0.01, 0.02, 0.03])),
        primitives.cylinder(0.01, 0.02),
        primitives.superquadric(np.array([0.01, 0.02, 0.03]), 0.5, 0.5),
    ):
        edges = Edges.of(mesh.faces)
        assert (edges.open_count, edges.crowded_count, edges.flipped_count) == (0, 0, 0)
        a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
        assert np.einsum("mc,mc->", a, np.cross(b, c)) > 0.0


def test_an_endless_surface_is_drawn_as_seen_from_above() -> None:
    mesh = drawn_shape(Ramp(0.15, 0.4), reach_m=0.05)
    x, _, z = mesh.vertices.T
    assert np.allclose(z[x <= 0.0], 0.0, atol=2e-5)
    assert z.max() > 0.005
    assert np.all(mesh.face_normals()[:, 2] > 0.0)


def test_edges_of_a_box_are_found_with_both_their_faces() -> None:
    edges = Box((0.06, 0.04, 0.03)).edges
    assert len(edges) == 12
    found = edges.nearest(np.array([0.031, 0.0, 0.031]))
    assert np.allclose(found.point, [0.03, 0.0, 0.03])
    assert abs(found.tangent[1]) == pytest.approx(1.0)
    assert sorted(map(tuple, found.normals.round(9).tolist())) == [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]


def test_the_rim_of_a_cylinder_is_a_smooth_curve() -> None:
    edges = Cylinder(0.03, 0.05).edges
    for angle in np.linspace(0.0, 6.0, 50):
        out = np.array([math.cos(angle), math.sin(angle), 0.0])
        found = edges.nearest(0.032 * out + [0.0, 0.0, 0.052])
        assert np.linalg.norm(found.point - 0.03 * out - [0.0, 0.0, 0.05]) < 0.03 * MM
        assert abs(found.tangent @ out) < math.sin(math.radians(0.5))


@pytest.mark.parametrize("compiled", [True, False])
def test_a_corner_of_a_rim_is_as_far_away_as_it_is_from_wherever_it_is_seen(
    compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From far above, the nearest point of a hollow top is its rim, where the wall's own normal leads elsewhere."""
    if not compiled:
        monkeypatch.setattr("touchcell.simulation.meshes.mesh_shape.extension", lambda _: None)
    angle = np.arange(24) * 2.0 * math.pi / 24
    profile = np.array([[0.0, 0.0], [0.06, 0.0], [0.06, 0.05], [0.03, 0.04], [0.0, 0.038]])
    cup = MeshShape(primitives.turned(profile, len(angle)), math.radians(30.0))
    for height in (0.2, 0.35, 0.5):
        for at in angle[:4]:
            p = np.array([0.002 * math.cos(at), 0.002 * math.sin(at), height])
            vertices = cup.drawn().vertices
            found = cup.nearest(p)
            assert found.distance_m == pytest.approx(np.linalg.norm(vertices - p, axis=1).min(), abs=2e-3)


@pytest.mark.parametrize("uneven", [False, True])
def test_normals_on_a_rim_are_those_of_the_surface(uneven: bool) -> None:
    # The cut of a saddle by a cylinder: rings of its face, and a wall below.
    rng = np.random.default_rng(4)
    angle = np.arange(84) * 2.0 * math.pi / 84
    rings = []
    for i in range(8):
        at = angle + (rng.uniform(-0.01, 0.01, 84) if uneven and i else 0.02 * i)
        x, y = (0.045 - 0.0034 * i) * np.cos(at), (0.045 - 0.0034 * i) * np.sin(at)
        rings.append(np.stack([x, y, x**2 / 0.24 - y**2 / 0.18], axis=1))
    foot = rings[0] - [0.0, 0.0, 0.025]
    mesh = smooth(TriangleMesh(np.concatenate([foot, *rings]), primitives.grid_faces(9, 84, closed=True)), CREASE)
    corners = mesh.mesh.vertices[mesh.mesh.faces]
    on_rim = (np.hypot(corners[..., 0], corners[..., 1]) > 0.0449) & (mesh.mesh.face_normals()[:, None, 2] ** 2 > 1e-14)
    true = np.stack([-corners[..., 0] / 0.12, corners[..., 1] / 0.09, np.ones(corners.shape[:2])], axis=2)
    true /= np.linalg.norm(true, axis=2, keepdims=True)
    cos = np.abs(np.einsum("mkc,mkc->mk", true, mesh.normals))[on_rim]
    assert np.degrees(np.arccos(np.minimum(cos, 1.0))).max() < 0.1
