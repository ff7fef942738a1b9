import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.core.scene import ContactState
from touchcell.simulation.closed_forms import Box
from touchcell.simulation.contact import ContactLaw, ContactModel, contact_at
from touchcell.simulation.motions import Glide, Periodic, Still
from touchcell.simulation.surfaces import Dome, Plane, Ramp, Surface

LAW = ContactLaw()
RADIUS = LAW.tip_radius_m


def rotation(alpha: float, beta: float, gamma: float) -> np.ndarray:
    ca, sa, cb, sb, cg, sg = (f(angle) for angle in (alpha, beta, gamma) for f in (math.cos, math.sin))
    Rx = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    Ry = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    Rz = np.array([[cg, -sg, 0], [sg, cg, 0], [0, 0, 1]])
    return Rz @ Ry @ Rx


def euler(x: float, y: float, z: float, alpha: float, beta: float, gamma: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rotation(alpha, beta, gamma)
    T[:3, 3] = x, y, z
    return T


# The surface z = 0 with outside +z: {f} looks down, one radius above it.
T_WORLD_F = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, RADIUS], [0, 0, 0, 1.0]])
FLAT = Surface(Plane())


def run(
    model: ContactModel, path: Callable[[float], np.ndarray], surface: Surface, dt: float, end: float
) -> ContactState:
    for k in range(round(end / dt) + 1):
        state = model.step(path(k * dt), surface, k * dt)
    return state


@given(
    x=st.floats(-0.004, 0.004),
    y=st.floats(-0.004, 0.004),
    z=st.floats(0.0048, 0.006),
    alpha=st.floats(-0.4, 0.4),
    beta=st.floats(-0.4, 0.4),
    gamma=st.floats(-0.08, 0.08),
)
def test_tilt_press_shear_ends_in_exactly_the_specs_pose(
    x: float, y: float, z: float, alpha: float, beta: float, gamma: float
) -> None:
    if math.hypot(x, y) > 5.5e-3:
        return
    model = ContactModel()

    def path(t: float) -> np.ndarray:
        press, shear = min(t, 1.0), max(t - 1.0, 0.0)
        return T_WORLD_F @ euler(x * shear, y * shear, -0.001 + (z + 0.001) * press, alpha, beta, gamma * shear)

    state = run(model, path, FLAT, 0.05, 2.0)
    np.testing.assert_allclose(state.T_f_s, euler(x, y, z, alpha, beta, gamma), atol=1e-12)
    np.testing.assert_allclose(state.T_world_f, T_WORLD_F, atol=1e-12)
    np.testing.assert_allclose(state.T_f_s @ state.T_s_f, np.eye(4), atol=1e-12)
    assert state.in_contact
    assert not state.slipping
    assert state.normal_force_n == pytest.approx(1500 * z)


def test_the_measured_slip_law() -> None:
    for depth_mm, survives_mm in ((1, 0.34), (2, 1.2), (3, 2.5), (4, 4.2)):
        assert LAW.max_shear_m(depth_mm * 1e-3) * 1e3 == pytest.approx(survives_mm, rel=0.06)
    assert LAW.max_shear_m(4.5e-3) >= 5e-3
    assert LAW.max_torsion_rad(4.5e-3) > math.radians(5)
    assert LAW.max_torsion_rad(0.5e-3) < math.radians(2)
    assert LAW.max_shear_m(-1e-3) == LAW.max_torsion_rad(-1e-3) == 0.0


def test_sliding_keeps_the_largest_shear_and_points_backwards_after_a_turn() -> None:
    model = ContactModel()
    z = 0.002
    longest = LAW.max_shear_m(z)
    out = run(model, lambda t: T_WORLD_F @ euler(0.02 * t, 0, z, 0, 0, 0), FLAT, 0.002, 1.0)
    assert out.slipping
    np.testing.assert_allclose(out.T_f_s[:3, 3], [longest, 0, z], atol=1e-12)
    back = model.step(T_WORLD_F @ euler(0.02 - 0.5 * longest, 0, z, 0, 0, 0), FLAT, 1.1)
    assert not back.slipping
    np.testing.assert_allclose(back.T_f_s[:3, 3], [0.5 * longest, 0, z], atol=1e-12)


def test_rising_sheds_shear_and_lift_off_forgets_it() -> None:
    model = ContactModel()
    run(model, lambda t: T_WORLD_F @ euler(0.004 * t, 0, 0.006, 0, 0, 0), FLAT, 0.01, 1.0)
    shallow = model.step(T_WORLD_F @ euler(0.004, 0, 0.001, 0, 0, 0), FLAT, 1.1)
    assert shallow.T_f_s[0, 3] == pytest.approx(LAW.max_shear_m(0.001))
    off = model.step(T_WORLD_F @ euler(0.004, 0, -0.003, 0.1, 0, 0), FLAT, 1.2)
    assert not off.in_contact
    assert off.normal_force_n == 0.0
    np.testing.assert_allclose(off.T_f_s, euler(0, 0, -0.003, 0.1, 0, 0), atol=1e-12)
    again = model.step(T_WORLD_F @ euler(0.004, 0, 0.005, 0, 0, 0), FLAT, 1.3)
    np.testing.assert_allclose(again.T_f_s[:3, 3], [0, 0, 0.005], atol=1e-12)


def test_torsion_slips_like_shear() -> None:
    model = ContactModel()
    z = 0.001
    state = run(model, lambda t: T_WORLD_F @ euler(0, 0, z, 0.2, 0.1, 0.5 * t), FLAT, 0.002, 1.0)
    assert state.slipping
    np.testing.assert_allclose(state.T_f_s, euler(0, 0, z, 0.2, 0.1, LAW.max_torsion_rad(z)), atol=1e-9)


def test_a_moving_plate_drags_the_skin_the_other_way() -> None:
    plate = Surface(Plane(), Glide(np.eye(4), np.array([0.003, 0, 0, 0, 0, 0.0]), start_s=0.0, duration_s=1.0))
    state = run(ContactModel(), lambda t: T_WORLD_F @ euler(0, 0, 0.005, 0, 0, 0), plate, 0.002, 1.0)
    np.testing.assert_allclose(state.T_f_s[:3, 3], [-0.003, 0, 0.005], atol=1e-12)
    turned = Surface(Plane(), Glide(np.eye(4), np.array([0, 0, 0, 0, 0, 0.1]), start_s=0.0, duration_s=1.0))
    state = run(ContactModel(), lambda t: T_WORLD_F @ euler(0, 0, 0.005, 0, 0, 0), turned, 0.002, 1.0)
    # {f} looks down, so the plate's positive turn about world z is a negative one about its own, and {s} stays behind.
    np.testing.assert_allclose(state.T_f_s, euler(0, 0, 0.005, 0, 0, 0.1), atol=1e-12)


def test_moving_with_the_plate_leaves_the_contact_unchanged() -> None:
    motion = Periodic(
        np.eye(4),
        np.array([0.07, 0.07, 0.02, 0.3, 0.3, 0.5]),
        np.array([0, 1.6, 0, 1, 2, 0.0]),
        period_s=4.0,
        ramp_s=1.0,
    )
    held = euler(0, 0, 0.003, 0.1, -0.2, 0)
    state = run(ContactModel(), lambda t: motion.pose(t) @ T_WORLD_F @ held, Surface(Plane(), motion), 0.01, 5.0)
    np.testing.assert_allclose(state.T_f_s, held, atol=1e-12)
    assert not state.slipping


def over_the_dome(t: float) -> np.ndarray:
    angle = 0.5 * t
    z = 0.003 + 0.001 * math.sin(3 * t)
    R = rotation(angle, 0, 0) @ rotation(0.1 * math.sin(2 * t), 0, 0.3 * t)
    T = np.eye(4)
    T[:3, :3] = R @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = rotation(angle, 0, 0) @ np.array([0.01 * math.sin(t), 0, 0.05 + RADIUS - z])
    return T


def up_the_ramp(t: float) -> np.ndarray:
    x = 0.05 * t - 0.02
    p = Ramp(0.08, 0.5).nearest(np.array([x, 0, 0.0]))
    T = np.eye(4)
    T[:3, :3] = rotation(0, 0.2 * t, 0.2 * t) @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = p.point + (RADIUS - 0.003) * p.normal + np.array([0, 0.01 * math.sin(3 * t), 0])
    return T


@pytest.mark.parametrize(
    ("path", "surface"),
    [(over_the_dome, Surface(Dome(0.05))), (up_the_ramp, Surface(Ramp(0.08, 0.5)))],
    ids=["dome", "ramp"],
)
def test_shear_does_not_depend_on_the_step(path: Callable[[float], np.ndarray], surface: Surface) -> None:
    coarse, fine = (run(ContactModel(), path, surface, dt, 2.0).T_f_s for dt in (0.002, 0.001))
    shear = np.linalg.norm(fine[:2, 3])
    assert shear > 0.5e-3
    assert np.linalg.norm(coarse[:2, 3] - fine[:2, 3]) < 0.01 * shear
    assert np.abs(coarse[:3, :3] - fine[:3, :3]).max() < 0.01


def test_sticking_over_a_curved_surface_comes_back_without_drift() -> None:
    model = ContactModel()

    def path(t: float) -> np.ndarray:
        T = np.eye(4)
        lean = rotation(0.05 * math.sin(2 * math.pi * t), 0.05 * (1 - math.cos(2 * math.pi * t)), 0)
        T[:3, :3] = np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = lean @ np.array([0, 0, 0.05 + RADIUS - 0.005])
        return T

    dome = Surface(Dome(0.05))
    start = model.step(path(0), dome, 0.0)
    for k in range(1, 501):
        state = model.step(path(k / 50), dome, k / 50)
    np.testing.assert_allclose(state.T_f_s, start.T_f_s, atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_horizontal_sensor_above_a_table_needs_no_special_case(side: float) -> None:
    lying = euler(0, 0, -0.1, 0, 0, 0)
    # Exactly along an axis, which no product of sines and cosines is.
    lying[:3, :3] = np.array([[0, 0, side], [0, 1, 0], [-side, 0, 0]])
    state = ContactModel().step(T_WORLD_F @ lying, FLAT, 0.0)
    assert not state.in_contact
    np.testing.assert_allclose(state.T_f_s, lying, atol=1e-12)


def test_another_surface_is_another_contact() -> None:
    model = ContactModel()
    run(model, lambda t: T_WORLD_F @ euler(0.004 * t, 0, 0.006, 0, 0, 0), FLAT, 0.01, 1.0)
    state = model.step(T_WORLD_F @ euler(0.004, 0, 0.006, 0, 0, 0), Surface(Plane(), Still()), 1.01)
    np.testing.assert_allclose(state.T_f_s[:2, 3], [0, 0], atol=1e-12)


@given(
    x=st.floats(-0.005, 0.005),
    y=st.floats(-0.005, 0.005),
    z=st.floats(0.0005, 0.006),
    alpha=st.floats(-0.4, 0.4),
    beta=st.floats(-0.4, 0.4),
    gamma=st.floats(-0.08, 0.08),
)
def test_contact_at_agrees_with_the_motion(
    x: float, y: float, z: float, alpha: float, beta: float, gamma: float
) -> None:
    model = ContactModel()
    model.step(T_WORLD_F @ euler(0, 0, z, alpha, beta, 0), FLAT, 0.0)
    wanted = euler(x, y, z, alpha, beta, gamma)
    moved = model.step(T_WORLD_F @ wanted, FLAT, 1.0)
    direct = contact_at(wanted, LAW)
    np.testing.assert_allclose(direct.T_f_s, moved.T_f_s, atol=1e-12)
    assert direct.slipping == moved.slipping


def test_a_tip_that_comes_out_of_the_other_side_of_a_plate_has_a_contact_there() -> None:
    # Its nearest point jumps to a face that looks the other way: half a turn of the normal.
    plate, model = Surface(Box((0.1, 0.1, 0.002))), ContactModel()
    model.step(euler(0.0, 0.0, 0.019, math.pi, 0.0, 0.0), plate, 0.0)
    state = model.step(euler(0.0, 0.0, -0.019, math.pi, 0.0, 0.0), plate, 0.0)
    assert state.in_contact
    np.testing.assert_allclose(state.T_world_f[:3, 2], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(state.T_world_f[:3, :3].T @ state.T_world_f[:3, :3], np.eye(3), atol=1e-12)
