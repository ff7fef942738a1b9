import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.simulation import solids
from touchcell.simulation.objects import BoxShape, HexagonShape
from touchcell.simulation.shapes import Ball, Prism, Solid, Turned
from touchcell.simulation.solids import friction_radius_m, mass_properties, plain_shape_of, shape_of

SQUARE = BoxShape(kind="box", size_mm=(80, 80, 60)).build()
SLAB = BoxShape(kind="box", size_mm=(120, 30, 50)).build()
HEXAGON = HexagonShape(kind="hexagon", width_mm=80, height_mm=60).build()
BOTTLE = Turned(((0.12, 0.03), (0.04, 0.0125)))
SOLIDS: list[Solid] = [SQUARE, SLAB, HEXAGON, BOTTLE, Ball(0.05)]

metres = st.floats(-0.15, 0.15)


def samples(solid: Solid, count: int = 40_000) -> np.ndarray:
    """Points evenly spread through the solid."""
    rng = np.random.default_rng(3)
    p = rng.uniform(-0.15, 0.2, (20 * count, 3))
    match solid:
        case Ball(radius_m):
            return p[np.linalg.norm(p, axis=1) < radius_m]
        case Turned(sections_m):
            inside, bottom = np.zeros(len(p), dtype=bool), 0.0
            for height_m, radius_m in sections_m:
                inside |= (np.hypot(p[:, 0], p[:, 1]) < radius_m) & (p[:, 2] > bottom) & (p[:, 2] < bottom + height_m)
                bottom += height_m
            return p[inside]
        case Prism(outline_m, height_m):
            inside = (p[:, 2] > 0.0) & (p[:, 2] < height_m)
            for a, b in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
                inside &= (b[0] - a[0]) * (p[:, 1] - a[1]) > (b[1] - a[1]) * (p[:, 0] - a[0])
            return p[inside]


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
def test_mass_properties_are_those_of_many_points(solid: Solid) -> None:
    points, found = samples(solid), mass_properties(solid)
    np.testing.assert_allclose(found.com_m, points.mean(axis=0), atol=7e-4)
    off = points - found.com_m
    squares = (off**2).mean(axis=0)
    np.testing.assert_allclose(found.inertia_per_kg_m2, squares.sum() - squares, rtol=0.03)


def test_friction_turns_with_the_lever_of_uniform_pressure() -> None:
    assert friction_radius_m(Turned(((0.06, 0.04),))) == pytest.approx(2.0 / 3.0 * 0.04)
    # The closed form for a square (Mason 1986): w (sqrt 2 + asinh 1) / 6.
    assert friction_radius_m(SQUARE) == pytest.approx(0.08 * (math.sqrt(2.0) + math.asinh(1.0)) / 6.0)
    for solid in (SLAB, HEXAGON):
        bottom = samples(solid)[:, :2]
        assert friction_radius_m(solid) == pytest.approx(np.linalg.norm(bottom, axis=1).mean(), rel=0.01)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
@given(x=metres, y=metres, z=metres)
def test_the_nearest_point_lies_on_the_solid_along_the_normal(solid: Solid, x: float, y: float, z: float) -> None:
    shape, p = shape_of(solid), np.array([x, y, z])
    found = shape.nearest(p)
    assert np.linalg.norm(found.normal) == pytest.approx(1.0)
    np.testing.assert_allclose(found.point + found.distance_m * found.normal, p, atol=1e-12)
    if found.distance_m > 1e-6:
        assert abs(shape.nearest(found.point).distance_m) < 1e-9


@pytest.mark.parametrize("solid", [SQUARE, SLAB, HEXAGON], ids=["square", "slab", "hexagon"])
@given(x=metres, y=metres, z=metres)
def test_the_face_before_a_point_is_the_nearest_of_all(solid: Prism, x: float, y: float, z: float) -> None:
    shape = plain_shape_of(solid)
    found = shape.nearest_numbers(x, y, z)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solids, "_CLEAR_M", math.inf)
        assert found == shape.nearest_numbers(x, y, z)


def test_mujoco_finds_the_same_distances() -> None:
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.06, 0.015, 0.025], pos=[0, 0, 0.025])
    spec.worldbody.add_body(name="probe", mocap=True).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    shape, compared = shape_of(SLAB), 0
    for p in np.random.default_rng(5).uniform(-0.15, 0.15, (300, 3)):
        data.mocap_pos[0] = p
        mujoco.mj_kinematics(model, data)
        distance_m = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) + 1e-3
        if distance_m > 2e-3:
            compared += 1
            assert shape.nearest(p).distance_m == pytest.approx(distance_m, abs=1e-5)
    assert compared > 200
