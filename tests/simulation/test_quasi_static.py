"""Quasi-static pushing against closed forms: force, yaw, rest below the limit, dissipation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.scene import ContactState
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.objects import ObjectConfig, TableConfig
from touchcell.simulation.quasi_static import QuasiStaticWorld
from touchcell.simulation.scene import SceneConfig
from touchcell.simulation.solids import friction_radius_m, shape_of, supports_m

LAW = ContactLaw()
DT_S = 0.002
SPEED_M_S = 0.03
MASS_G = 400.0
WEIGHT_N = 0.4 * 9.81
SQUARE = {"kind": "box", "size_mm": (80, 80, 60)}
HEXAGON = {"kind": "hexagon", "width_mm": 80, "height_mm": 60}
ROUND = {"kind": "cylinder", "diameter_mm": 80, "height_mm": 60}
BOTTLE = {"kind": "bottle", "sections_mm": [[40, 80], [30, 40]]}


def world(shape: dict, friction: float = 0.3) -> QuasiStaticWorld:
    table = TableConfig(friction=friction)
    return QuasiStaticWorld({}, {"it": ObjectConfig(shape=shape, mass_g=MASS_G).build(table)}, LAW)


def tip(x_mm: float, y_mm: float, z_mm: float = 30.0, heading_deg: float = 0.0) -> Array:
    """T_world_s (4, 4) of a tip that points along the heading, its x axis down."""
    c, s = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, -s, c], [0.0, c, s], [-1.0, 0.0, 0.0]])
    T[:3, 3] = 1e-3 * np.array([x_mm, y_mm, z_mm])
    return T


def push(it: QuasiStaticWorld, T: Array, velocity: tuple[float, ...], duration_s: float, t_s: float) -> ContactState:
    """Move the tip from ``T`` on, in place, and return what it feels at the end."""
    for _ in range(round(duration_s / DT_S)):
        T[:2, 3] += DT_S * np.array(velocity)
        t_s += DT_S
        state = it.step({"tip": T}, t_s)["tip"]()
    return state


def pose(it: QuasiStaticWorld) -> tuple[float, float, float]:
    """x and y in mm, yaw in degrees."""
    T = it.objects()["it"]
    return 1e3 * T[0, 3], 1e3 * T[1, 3], math.degrees(math.atan2(T[1, 0], T[0, 0]))


@pytest.mark.parametrize("shape", [SQUARE, HEXAGON, ROUND, BOTTLE])
@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_a_central_push_needs_friction_times_weight_and_moves_straight(shape, friction):
    it, T = world(shape, friction), tip(-60.0, 0.0)
    it.mount("tip", T, 0.0)
    state = push(it, T, (SPEED_M_S, 0.0), 2.0, 0.0)
    assert state.normal_force_n == pytest.approx(friction * WEIGHT_N, rel=1e-4)
    assert state.depth_m == pytest.approx(friction * WEIGHT_N / LAW.stiffness_n_m, rel=1e-4)
    x, y, yaw = pose(it)
    assert x == pytest.approx(60.0 - 1e3 * state.depth_m, abs=1e-3)
    assert (y, yaw) == pytest.approx((0.0, 0.0), abs=1e-6)


def yaw_per_m(shape: dict, offset_mm: float, x_mm: float, z_mm: float = 0.0) -> float:
    """Of a push along x from ``x_mm`` at ``offset_mm`` to the left, over 0.6 mm once it slides."""
    it, T = world(shape), tip(x_mm, offset_mm, z_mm)
    it.mount("tip", T, 0.0)
    push(it, T, (SPEED_M_S, 0.0), 0.06, 0.0)
    before = pose(it)[2]
    push(it, T, (SPEED_M_S, 0.0), 0.02, 0.06)
    return math.radians(pose(it)[2] - before) / (SPEED_M_S * 0.02)


@pytest.mark.parametrize("size_mm", [(80, 80), (50, 120), (120, 50)])
@pytest.mark.parametrize("offset_mm", [-10.0, 4.0, 15.0])
@pytest.mark.parametrize("z_mm", [0.0, 20.0])
def test_an_off_centre_push_turns_a_box_as_a_pressure_does_that_its_height_shifts(size_mm, offset_mm, z_mm):
    """A sticking tip that does not rotate: its centre moves with the object, its force acts on the face.

    The pressure is integrated over the bottom. On an even ground it is linear; its moment is that of the push above it.
    """
    half_x, half_y = 0.5 * np.array(size_mm)
    yaw = yaw_per_m({"kind": "box", "size_mm": [*size_mm, 60]}, offset_mm, -half_x - 20.5, z_mm)
    face, centre, y = -1e-3 * half_x, -1e-3 * half_x - 0.020, 1e-3 * offset_mm
    across = np.meshgrid(np.arange(1.0 - half_x, half_x, 2.0), np.arange(1.0 - half_y, half_y, 2.0))
    px, py = (0.001 * np.array(across)).reshape(2, -1)
    rates = np.linspace(-30.0, 30.0, 1201)
    unbalanced = []
    for w in rates:
        vx, vy = 1.0 - w * (py - y), w * (px - centre)
        speed = np.hypot(vx, vy)
        pressure = np.ones(len(px))
        for _ in range(3):
            fx, fy = (pressure * vx / speed).mean(), (pressure * vy / speed).mean()
            pressure = 1.0 + 0.3e-3 * z_mm * (fx * px / (px**2).mean() + fy * py / (py**2).mean())
        moment = (pressure * (px * vy - py * vx) / speed).mean()
        unbalanced.append(moment - (face * fy - y * fx))
    assert yaw == pytest.approx(rates[int(np.argmin(np.abs(unbalanced)))], rel=0.05, abs=0.05)


@pytest.mark.parametrize("shape", [SQUARE, HEXAGON, ROUND])
def test_an_object_held_below_the_limit_does_not_creep(shape):
    it, T = world(shape), tip(-60.5, 7.0)
    it.mount("tip", T, 0.0)
    push(it, T, (SPEED_M_S, 0.0), 0.5, 0.0)
    there = it.objects()["it"].copy()
    push(it, T, (-0.0001, 0.0), 0.01, 0.5)
    push(it, T, (0.0, 0.0), 2.0, 0.51)
    np.testing.assert_array_equal(it.objects()["it"], there)


def test_a_tip_that_was_pushed_too_deep_comes_out_in_one_step():
    it = world(SQUARE)
    it.mount("tip", tip(-50.0, 0.0), 0.0)
    state = it.step({"tip": tip(-50.0, 0.0)}, DT_S)["tip"]()
    assert state.normal_force_n == pytest.approx(0.3 * WEIGHT_N, rel=1e-4)


def test_sideways_the_tip_drags_the_object_until_its_skin_slips():
    it, T = world(SQUARE), tip(-58.0, 0.0)
    other = tip(58.0, 0.0, heading_deg=180.0)
    for name, start in (("tip", T), ("other", other)):
        it.mount(name, start, 0.0)
    dragged = 0.0
    for i in range(1, 500):
        T[1, 3] += DT_S * SPEED_M_S
        other[1, 3] += DT_S * SPEED_M_S
        states = {name: felt() for name, felt in it.step({"tip": T, "other": other}, i * DT_S).items()}
        dragged = pose(it)[1]
    assert dragged > 25.0
    assert abs(pose(it)[2]) < 0.1
    held = sum(abs(s.T_f_s[1, 3]) * LAW.shear_stiffness_n_m(s.depth_m) for s in states.values())
    assert held == pytest.approx(0.3 * WEIGHT_N, rel=1e-3)


def test_pressing_down_adds_to_the_weight():
    it, T = world(SQUARE), tip(-57.0, 0.0)
    it.mount("tip", T, 0.0)
    push(it, T, (SPEED_M_S, 0.0), 0.1, 0.0)
    T[2, 3] -= 0.00005
    state = push(it, T, (SPEED_M_S, 0.0), 0.1, 0.1)
    down = state.T_f_s[0, 3] * LAW.shear_stiffness_n_m(state.depth_m)
    assert down > 0.05
    assert state.normal_force_n == pytest.approx(0.3 * (WEIGHT_N + down), rel=5e-3)


MOVES = st.lists(st.tuples(st.floats(-0.03, 0.05), st.floats(-0.04, 0.04), st.integers(1, 40)), min_size=1, max_size=4)


@settings(max_examples=12)
@given(shape=st.sampled_from([SQUARE, HEXAGON, ROUND]), offset=st.floats(-20.0, 20.0), moves=MOVES)
def test_friction_dissipates_and_its_limit_holds_whatever_the_tip_does(shape, offset, moves):
    it, T = world(shape), tip(-61.0, offset)
    it.mount("tip", T, 0.0)
    solid = ObjectConfig(shape=shape, mass_g=1.0).build(TableConfig()).solid
    radius, supports = friction_radius_m(solid), supports_m(solid)
    i = 0
    for vx, vy, steps in moves:
        for _ in range(steps):
            i += 1
            before = it.objects()["it"]
            T[:2, 3] += DT_S * np.array([vx, vy])
            state = it.step({"tip": T}, i * DT_S)["tip"]()
            after = it.objects()["it"]
            force = state.T_world_f[:3, 2] * state.normal_force_n
            if state.in_contact:
                shear = state.T_world_f[:3, :2] @ state.T_f_s[:2, 3]
                force += shear * LAW.shear_stiffness_n_m(state.depth_m)
            point = T[:3, 3] + state.T_world_f[:3, 2] * (LAW.tip_radius_m - state.depth_m) - after[:3, 3]
            moment = point[0] * force[1] - point[1] * force[0]
            limit = 0.3 * (WEIGHT_N - force[2])
            assert math.hypot(force[0], force[1]) <= limit * 1.001 + 1e-9
            assert abs(moment) <= 1.01 * radius * limit + 1e-9
            shift = after[:2, 3] - before[:2, 3]
            turn = math.remainder(
                math.atan2(after[1, 0], after[0, 0]) - math.atan2(before[1, 0], before[0, 0]), 2 * math.pi
            )
            work = force[:2] @ shift + moment * turn
            assert work >= -1e-9
            if np.abs(shift).max() > 1e-7:
                R = before[:2, :2]
                ways = [shift + turn * (R @ np.array([-y, x])) for x, y in supports]
                dissipated = limit * np.linalg.norm(ways, axis=1).mean()
                assert work == pytest.approx(dissipated, rel=0.02)


def test_the_same_moves_give_the_same_poses():
    runs = []
    for _ in range(2):
        it, T = world(HEXAGON), tip(-60.5, 3.0)
        it.mount("tip", T, 0.0)
        push(it, T, (SPEED_M_S, 0.004), 0.5, 0.0)
        runs.append(it.objects()["it"])
    np.testing.assert_array_equal(*runs)


def test_a_scene_is_made_of_it():
    config = {"physics": "quasi_static", "objects": {"it": {"shape": SQUARE, "mass_g": 400}}}
    scene = SceneConfig.model_validate(config).build(clock := VirtualClock())
    scene.mount("tip", lambda: tip(-59.0 + 20.0 * clock.now_ns() * 1e-9, 0.0))
    clock.sleep_until_ns(10**9)
    assert scene.objects().value["it"][0, 3] == pytest.approx(0.021 - 0.3 * WEIGHT_N / 1500.0, abs=2e-4)
    with pytest.raises(ValidationError, match="kinematic"):
        SceneConfig.model_validate({**config, "physics": "kinematic"})
    ball = {"it": {"shape": {"kind": "ball", "diameter_mm": 60}, "mass_g": 40}}
    with pytest.raises(ConfigError, match="rolls"):
        SceneConfig.model_validate({**config, "objects": ball}).build(clock)
    leaning = {"it": {"shape": SQUARE, "mass_g": 400, "pose_mm_deg": (0, 0, 0, 5, 0, 0)}}
    with pytest.raises(ConfigError, match="upright"):
        SceneConfig.model_validate({**config, "objects": leaning}).build(clock)


def test_a_snapshot_brings_object_and_contact_back():
    it, T = world(SQUARE), tip(-60.5, 3.0)
    it.mount("tip", T, 0.0)
    push(it, T, (SPEED_M_S, 0.004), 0.3, 0.0)
    restore, there = it.snapshot(), T.copy()
    ends = []
    for _ in range(2):
        state = push(it, T, (SPEED_M_S, -0.004), 0.3, 0.3)
        ends.append((it.objects()["it"], state.T_f_s))
        T[:] = there
        restore()
    np.testing.assert_array_equal(ends[0], ends[1])


@pytest.mark.parametrize("shape", [SQUARE, HEXAGON, ROUND])
def test_on_a_face_the_normal_is_the_faces(shape):
    """The anchor of dragged skin is on the surface but for rounding."""
    body = shape_of(ObjectConfig(shape=shape, mass_g=1.0).build(TableConfig()).solid)
    for y in np.linspace(-0.015, 0.015, 61):
        on = body.nearest(np.array([-0.1, y, 0.02])).point
        for off in (-1e-17, 0.0, 1e-17):
            found = body.nearest(on + np.array([off, off, 0.0]))
            assert found.normal[0] < -0.9
            assert np.linalg.norm(found.normal) == pytest.approx(1.0)
