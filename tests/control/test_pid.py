"""The feedforward and PID controller of paper eq. 19."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from touchcell.control.errors import ControlError
from touchcell.control.pid import Pid, PidGains

ZERO = np.zeros(6)
WIDE = np.full(6, 1e6)


def gains(kp=0.0, ki=0.0, kd=0.0, integral_limit=WIDE, integral_zone=WIDE, output_limit=WIDE) -> PidGains:
    def of(gain):
        return np.full(6, gain) if np.ndim(gain) == 0 else np.asarray(gain)

    return PidGains(of(kp), of(ki), of(kd), integral_limit, integral_zone, output_limit)


def test_each_term_by_hand():
    pid = Pid(gains(kp=2.0, ki=4.0, kd=0.1))
    e1, e2 = np.arange(6.0), np.arange(6.0) + 1.0
    first = pid.step(e1, ZERO, 0.5)
    np.testing.assert_allclose(first, 2 * e1 + 4 * e1 * 0.5, atol=1e-15)
    second = pid.step(e2, np.ones(6), 0.5)
    # The average moved from e1 to (e1 + e2) / 2, by half of 1.
    expected = 1 + 2 * e2 + 4 * (e1 + e2) * 0.5 + 0.1 * 0.5 / 0.5
    np.testing.assert_allclose(second, expected, atol=1e-12)
    np.testing.assert_allclose(pid.integral, 2.0 * (e1 + e2), atol=1e-12)


def test_full_matrix_couples_axes():
    K = np.zeros((6, 6))
    K[0, 4] = 3.0
    out = Pid(gains(kp=K)).step(np.array([0, 0, 0, 0, 2.0, 0]), ZERO, 0.01)
    np.testing.assert_array_equal(out, [6.0, 0, 0, 0, 0, 0])
    assert gains(kp=K).controlled.tolist() == [True, False, False, False, False, False]


def test_an_axis_with_only_derivative_gain_is_controlled():
    assert gains(kd=np.array([0, 0, 1.0, 0, 0, 0])).controlled.tolist() == [False, False, True, False, False, False]


def test_the_average_halves_the_remaining_step():
    pid = Pid(gains(kd=1.0))
    pid.step(ZERO, ZERO, 1.0)
    rates = [pid.step(np.ones(6), ZERO, 1.0)[0] for _ in range(4)]
    np.testing.assert_allclose(rates, [0.5, 0.25, 0.125, 0.0625], atol=1e-15)


def test_integral_is_clipped_and_unwinds_at_once():
    limit = np.full(6, 0.25)
    pid = Pid(gains(ki=1.0, integral_limit=limit))
    for _ in range(100):
        out = pid.step(np.ones(6), ZERO, 0.1)
    np.testing.assert_array_equal(out, limit)
    np.testing.assert_allclose(pid.step(-np.ones(6), ZERO, 0.1), limit - 0.1, atol=1e-15)


def test_errors_outside_the_zone_are_not_integrated():
    pid = Pid(gains(ki=1.0, integral_zone=np.full(6, 0.5)))
    pid.step(np.array([0.5, 0.6, -0.4, -0.6, 0.0, 9.0]), ZERO, 1.0)
    np.testing.assert_array_equal(pid.integral, [0.5, 0.0, -0.4, 0.0, 0.0, 0.0])


def test_reset_starts_without_a_kick():
    settings = gains(kp=1.0, ki=1.0, kd=1.0)
    used = Pid(settings)
    for _ in range(5):
        used.step(np.full(6, -9.0), ZERO, 0.1)
    used.reset()
    e = np.full(6, 0.3)
    np.testing.assert_array_equal(used.step(e, ZERO, 0.1), Pid(settings).step(e, ZERO, 0.1))
    used.reset()
    np.testing.assert_allclose(used.step(e, ZERO, 0.1), e + e * 0.1, atol=1e-15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("argument", ["e", "V_ff"])
def test_non_finite_input_is_refused_and_leaves_the_state(argument, bad):
    pid = Pid(gains(kp=1.0, ki=1.0, kd=1.0))
    pid.step(np.ones(6), ZERO, 0.1)
    before = pid.integral
    values = {"e": ZERO, "V_ff": ZERO} | {argument: np.array([0, 0, bad, 0, 0, 0])}
    with pytest.raises(ControlError) as caught:
        pid.step(values["e"], values["V_ff"], 0.1)
    assert caught.value.argument == argument
    np.testing.assert_array_equal(pid.integral, before)


@pytest.mark.parametrize("dt_s", [0.0, -0.1, np.nan, np.inf])
def test_a_time_step_must_be_positive(dt_s):
    with pytest.raises(ControlError) as caught:
        Pid(gains()).step(ZERO, ZERO, dt_s)
    assert caught.value.argument == "dt_s"


def test_an_overflow_is_an_error_not_an_infinity():
    pid = Pid(gains(kp=1e10))
    with pytest.raises(ControlError):
        pid.step(np.full(6, 1e305), ZERO, 0.1)
    np.testing.assert_array_equal(pid.step(ZERO, ZERO, 0.1), ZERO)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kp", np.ones(5)),
        ("ki", np.full(6, np.nan)),
        ("kd", np.ones((6, 5))),
        ("integral_limit", -np.ones(6)),
        ("integral_zone", -np.ones(6)),
        ("output_limit", np.full(6, np.inf)),
        ("output_limit", np.ones((6, 6))),
    ],
)
def test_bad_gains_are_refused(name, value):
    good = {"kp": ZERO, "ki": ZERO, "kd": ZERO, "integral_limit": WIDE, "integral_zone": WIDE, "output_limit": WIDE}
    with pytest.raises(ControlError) as caught:
        PidGains(**(good | {name: value}))
    assert caught.value.argument == name


def test_gains_cannot_be_changed_from_outside():
    kp = np.ones(6)
    settings = gains(kp=kp)
    kp[0] = 99.0
    assert settings.kp[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        settings.kp[0, 0] = 2.0


vectors = arrays(np.float64, 6, elements=st.floats(-1e3, 1e3))
limits = arrays(np.float64, 6, elements=st.floats(0, 10))


@given(
    kp=arrays(np.float64, (6, 6), elements=st.floats(-50, 50)),
    ki=vectors,
    kd=vectors,
    integral_limit=limits,
    integral_zone=limits,
    output_limit=limits,
    steps=st.lists(st.tuples(vectors, vectors, st.floats(1e-4, 1.0)), min_size=1, max_size=8),
)
def test_output_and_integral_never_leave_their_clips(kp, ki, kd, integral_limit, integral_zone, output_limit, steps):
    pid = Pid(PidGains(kp, ki, kd, integral_limit, integral_zone, output_limit))
    for e, V_ff, dt_s in steps:
        out = pid.step(e, V_ff, dt_s)
        assert (np.abs(out) <= output_limit).all()
        assert (np.abs(pid.integral) <= integral_limit).all()


def test_an_error_outside_the_zone_unwinds_an_integral_of_the_other_sign_to_zero_at_most():
    pid = Pid(gains(ki=1.0, integral_zone=np.full(6, 0.5)))
    for _ in range(10):
        pid.step(np.full(6, -0.5), ZERO, 0.1)
    assert pid.integral == pytest.approx(np.full(6, -0.5))
    pid.step(np.full(6, 2.0), ZERO, 0.1)
    assert pid.integral == pytest.approx(np.full(6, -0.3))
    for _ in range(5):
        pid.step(np.full(6, 2.0), ZERO, 0.1)
    assert pid.integral == pytest.approx(np.zeros(6))
