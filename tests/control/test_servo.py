"""Tactile servoing on exact kinematics: the surface is static, the sensor moves as commanded."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from touchcell.control.errors import ControlError
from touchcell.control.pid import PidGains
from touchcell.control.servo import TactileServo
from touchcell.geometry import se3
from touchcell.geometry.errors import GeometryError

DT = 0.01
ZERO = np.zeros(6)
WIDE = np.full(6, 1e3)
ALL = np.ones(6)
NORMAL = np.array([0, 0, 1.0, 1.0, 1.0, 0])
MOUNT = se3.from_euler_mm_deg(np.array([20.0, -10.0, 70.0, 30.0, -20.0, 45.0]))


def contact(x=0.0, y=0.0, z=0.0, alpha=0.0, beta=0.0, gamma=0.0) -> np.ndarray:
    """Return T_s_f of a contact given as a label, mm and degrees."""
    return se3.inverse(se3.from_euler_mm_deg(np.array([x, y, z, alpha, beta, gamma])))


def servo(reference, axes=ALL, kp=8.0, ki=0.0, kd=0.0, T_tcp_sensor=MOUNT, output_limit=WIDE) -> TactileServo:
    return TactileServo(
        reference, T_tcp_sensor, PidGains(kp * axes, ki * axes, kd * axes, WIDE, WIDE, output_limit), DT
    )


def run(control, T_w_tcp, T_w_f, V_ff, steps, T_tcp_sensor=MOUNT):
    """Run an ideal arm: the tool follows the twist exactly. Return every pose of the sensor."""
    poses = []
    for k in range(steps):
        T_w_s = se3.compose(T_w_tcp, T_tcp_sensor)
        poses.append(T_w_s)
        V_tcp = control.step(se3.compose(se3.inverse(T_w_s), T_w_f), round(k * DT * 1e9), V_ff)
        T_w_tcp = se3.compose(T_w_tcp, se3.exp(V_tcp * DT))
    return poses


@pytest.mark.parametrize(
    ("present", "component", "sign"),
    [
        ({"z": 2.0}, 2, +1),  # too shallow: go in, along +z
        ({"z": 4.0}, 2, -1),
        ({"z": 3.0, "x": 1.0}, 0, -1),  # sheared to +x: go back
        ({"z": 3.0, "y": -1.0}, 1, +1),
        ({"z": 3.0, "gamma": 2.0}, 5, -1),
    ],
)
def test_signs(present, component, sign):
    e = servo(contact(z=3.0)).error(contact(**present))
    assert np.sign(e[component]) == sign
    np.testing.assert_allclose(np.delete(e, component), 0.0, atol=1e-12)


def test_error_is_the_motion_to_the_desired_sensor_pose():
    reference, present = contact(z=3.0), contact(x=1.0, y=-2.0, z=4.0, alpha=8.0, beta=-5.0, gamma=3.0)
    e = servo(reference).error(present)
    np.testing.assert_allclose(se3.compose(se3.inverse(se3.exp(e)), present), reference, atol=1e-12)


@pytest.mark.parametrize("ki", [0.0, 16.0])
def test_reaches_the_reference(ki):
    reference = contact(x=0.5, y=-0.3, z=3.0, alpha=2.0, beta=-1.0, gamma=1.0)
    start = contact(x=-2.0, y=3.0, z=1.0, alpha=-12.0, beta=9.0, gamma=-4.0)
    T_w_f = se3.from_euler_mm_deg(np.array([300.0, 100.0, 50.0, 170.0, 10.0, 60.0]))
    T_w_tcp = se3.compose(se3.compose(T_w_f, se3.inverse(start)), se3.inverse(MOUNT))
    poses = run(servo(reference, ki=ki), T_w_tcp, T_w_f, ZERO, 1500)
    np.testing.assert_allclose(se3.compose(se3.inverse(poses[-1]), T_w_f), reference, atol=1e-9)


def test_feedforward_slides_tangentially_at_depth():
    T_w_f = se3.from_euler_mm_deg(np.array([300.0, 100.0, 50.0, 170.0, 10.0, 60.0]))
    start = contact(z=2.0, alpha=6.0, beta=-8.0)
    T_w_tcp = se3.compose(se3.compose(T_w_f, se3.inverse(start)), se3.inverse(MOUNT))
    V_ff = np.array([0.02, 0.01, 0, 0, 0, 0])
    poses = run(servo(contact(z=3.0), axes=np.array([0, 0, 1.0, 1, 1, 0])), T_w_tcp, T_w_f, V_ff, 600)
    T_f_s = se3.compose(se3.inverse(T_w_f), poses[-1])
    np.testing.assert_allclose(T_f_s[:3, 2], [0, 0, 1], atol=1e-9)
    assert abs(T_f_s[2, 3] - 0.003) < 1e-9
    travelled = (se3.compose(se3.inverse(T_w_f), poses[-1]) - se3.compose(se3.inverse(T_w_f), poses[-2]))[:3, 3]
    assert abs(np.linalg.norm(travelled) - np.hypot(0.02, 0.01) * DT) < 1e-9
    assert abs(travelled[2]) < 1e-10


def test_feedforward_is_tangential_already_while_tilted():
    control = servo(contact(z=3.0), axes=np.array([0, 0, 1e-9, 0, 0, 0]), T_tcp_sensor=np.eye(4))
    present = contact(z=3.0, alpha=10.0, beta=-15.0)
    V = control.step(present, 0, np.array([0.02, 0, 0, 0, 0, 0]))
    # Alpha and beta are not controlled here: the reference is tilted likewise and the motion is along the sensor's x.
    np.testing.assert_allclose(V, [0.02, 0, 0, 0, 0, 0], atol=1e-10)
    control = servo(contact(z=3.0), axes=1e-9 * NORMAL, T_tcp_sensor=np.eye(4))
    V = control.step(present, 0, np.array([0.02, 0, 0, 0, 0, 0]))
    normal_s = present[:3, 2]
    assert abs(V[:3] @ normal_s) < 1e-9
    assert abs(np.linalg.norm(V[:3]) - 0.02) < 1e-9


def test_uncontrolled_shear_does_not_leak():
    axes = np.array([0, 0, 1.0, 1.0, 1.0, 0])
    plain = servo(contact(z=3.0), axes=axes, T_tcp_sensor=np.eye(4)).step(contact(z=3.0, alpha=5.0), 0, ZERO)
    sheared = servo(contact(z=3.0), axes=axes, T_tcp_sensor=np.eye(4)).step(
        contact(x=4.0, y=-3.0, z=3.0, alpha=5.0, gamma=5.0), 0, ZERO
    )
    np.testing.assert_allclose(sheared, plain, atol=1e-12)
    np.testing.assert_allclose(sheared[[0, 1, 5]], 0.0, atol=1e-12)


def test_twist_of_the_tool_agrees_with_finite_differences():
    control = servo(contact(z=3.0))
    present = contact(x=1.0, y=0.5, z=2.0, alpha=4.0, beta=-3.0, gamma=2.0)
    V_tcp = control.step(present, 0, np.array([0.01, 0, 0, 0, 0, 0.1]))
    V_s = servo(contact(z=3.0), T_tcp_sensor=np.eye(4)).step(present, 0, np.array([0.01, 0, 0, 0, 0, 0.1]))
    h = 1e-6
    T_w_tcp = se3.from_euler_mm_deg(np.array([400.0, 0.0, 300.0, 180.0, 0.0, 30.0]))
    before = se3.compose(T_w_tcp, MOUNT)
    after = se3.compose(se3.compose(T_w_tcp, se3.exp(V_tcp * h)), MOUNT)
    np.testing.assert_allclose(se3.log(se3.compose(se3.inverse(before), after)) / h, V_s, atol=1e-7)


def test_holds_its_output_until_the_next_estimate():
    control = servo(contact(z=3.0), kd=1.0)
    control.step(contact(z=2.0), 0, ZERO)
    first = control.step(contact(z=2.5), 33_000_000, ZERO)
    held = control.step(contact(z=2.5), 33_000_000, ZERO)
    older = control.step(contact(z=9.0), 20_000_000, ZERO)
    np.testing.assert_array_equal(first, held)
    np.testing.assert_array_equal(first, older)


def test_derivative_uses_the_time_between_estimates():
    control = servo(contact(z=3.0), kp=0.0, kd=1.0, T_tcp_sensor=np.eye(4))
    control.step(contact(z=3.0), 0, ZERO)
    V = control.step(contact(z=2.0), 50_000_000, ZERO)
    np.testing.assert_allclose(V, [0, 0, 0.5 * 0.001 / 0.05, 0, 0, 0], atol=1e-12)


def test_without_a_valid_estimate_nothing_moves_and_the_state_is_reset():
    control = servo(contact(z=3.0), ki=5.0)
    V_ff = np.array([0.02, 0, 0, 0, 0, 0])
    first = control.step(contact(z=1.0), 0, V_ff)
    control.step(contact(z=1.0), 10_000_000, V_ff)
    np.testing.assert_array_equal(control.step(None, 20_000_000, V_ff), ZERO)
    np.testing.assert_allclose(control.step(contact(z=1.0), 30_000_000, V_ff), first, atol=1e-15)


def test_non_finite_input_is_a_typed_error():
    control = servo(contact(z=3.0))
    with pytest.raises(GeometryError):
        control.step(np.full((4, 4), np.nan), 0, ZERO)
    with pytest.raises(ControlError):
        control.step(contact(z=3.0), 0, np.array([np.inf, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize("period_s", [0.0, -1.0, float("nan")])
def test_the_period_must_be_positive(period_s):
    with pytest.raises(ControlError):
        TactileServo(contact(z=3.0), MOUNT, PidGains(ALL, ALL, ALL, WIDE, WIDE, WIDE), period_s)


@given(
    present=arrays(np.float64, 6, elements=st.floats(-20, 20)),
    V_ff=arrays(np.float64, 6, elements=st.floats(-10, 10)),
    axes=arrays(np.bool_, 6),
)
def test_the_sensor_twist_is_bounded_and_free_axes_get_only_feedforward(present, V_ff, axes):
    limit = np.array([0.05, 0.05, 0.03, 0.5, 0.5, 0.4])
    control = servo(contact(z=3.0), axes=axes.astype(float), ki=3.0, T_tcp_sensor=np.eye(4), output_limit=limit)
    T_s_f = se3.inverse(se3.from_euler_mm_deg(present))
    V = control.step(T_s_f, 0, V_ff)
    assert (np.abs(V) <= limit + 1e-15).all()
    still = servo(contact(z=3.0), axes=axes.astype(float), ki=3.0, T_tcp_sensor=np.eye(4)).step(T_s_f, 0, ZERO)
    np.testing.assert_array_equal(still[~axes], 0.0)
