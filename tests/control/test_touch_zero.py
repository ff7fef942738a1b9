"""Where a sensor first touched, from the change of its image over the arm's advance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.touch_zero import TouchZero
from touchcell.geometry.types import Array

FRAME_NS = 33_000_000
STEP_NS = 11_000_000


def contact(depth_m: float) -> Array:
    T = np.eye(4)
    T[2, 3] = -depth_m
    return T


def approach(zero: TouchZero, at_m: float, read: float, misread_m: float, late_ns: int, gives_way_m: float) -> None:
    """Advance at 10 mm/s, rest 1.5 mm deep for half a second, and press on at 8 mm/s; the object yields in the end."""
    advance_m, t_ns, deepest_m = 0.0, 0, at_m + 1.5e-3
    rested_s, past = 0.0, []
    for seq in range(90):
        for _ in range(FRAME_NS // STEP_NS):
            t_ns += STEP_NS
            if advance_m < deepest_m:
                advance_m += 10e-3 * 1e-9 * STEP_NS
            elif rested_s < 0.5:
                rested_s += 1e-9 * STEP_NS
            else:
                advance_m += 8e-3 * 1e-9 * STEP_NS
            T = np.eye(4)
            T[2, 3] = advance_m
            past.append((t_ns, advance_m))
            zero.moved(t_ns, T)
        exposed_m = next((m for t, m in reversed(past) if t <= t_ns - late_ns), 0.0)
        depth_m = min(max(exposed_m - at_m, 0.0), gives_way_m)
        touched = contact(read * depth_m + misread_m) if depth_m > 0.3e-3 else None
        # Stamped as if it had come without delay.
        zero.saw(t_ns, seq, 0.004 if depth_m == 0.0 else 90.0 * depth_m, touched)


@given(st.floats(3e-3, 8e-3), st.floats(0.92, 1.05), st.floats(-0.5e-3, 0.5e-3), st.sampled_from([0, 9, 18, 27]))
def test_what_a_model_misreads_is_found_whatever_the_delay_of_frames(
    at_m: float, read: float, misread_m: float, late_ms: int
) -> None:
    zero = TouchZero()
    approach(zero, at_m, read, misread_m, late_ms * 1_000_000, 3.5e-3)
    assert zero.ended
    assert zero.error_m is not None
    # It is that of the depth at which the object gave way.
    assert zero.error_m == pytest.approx((read - 1.0) * 3.5e-3 + misread_m, abs=0.3e-3)


def test_nothing_is_told_before_the_sensor_rests_in_contact() -> None:
    zero = TouchZero()
    for seq in range(20):
        T = np.eye(4)
        T[2, 3] = 0.3e-3 * seq
        zero.moved(seq * FRAME_NS, T)
        zero.saw(seq * FRAME_NS, seq, 0.01 * seq, contact(0.1e-3 * seq))
    assert zero.error_m is None


def test_an_error_beyond_what_models_err_is_left_out() -> None:
    zero = TouchZero()
    approach(zero, 5e-3, 1.0, 2e-3, 0, 3.5e-3)
    assert zero.error_m is None


def test_a_light_object_that_gives_way_at_the_touch_does_not_seem_to_be_misread() -> None:
    """Its image stops changing as the arm advances, though the depth is read rightly."""
    zero = TouchZero()
    approach(zero, 5e-3, 1.0, 0.0, 0, 0.9e-3)
    assert zero.error_m == pytest.approx(0.0, abs=0.2e-3)


@given(st.floats(3e-3, 8e-3), st.floats(0.7, 1.05), st.sampled_from([0, 9, 18, 27]))
def test_the_change_per_depth_is_that_of_the_image_and_not_of_the_model(at_m: float, read: float, late_ms: int) -> None:
    zero = TouchZero()
    approach(zero, at_m, read, 0.0, late_ms * 1_000_000, 3.5e-3)
    assert zero.change_per_m == pytest.approx(90.0, rel=0.05)


def test_what_shear_changes_of_the_image_counts_for_no_depth() -> None:
    """The check after first touch presses on, and shifts the sensor there and back, before it rests."""
    zero, read_m = TouchZero(), -0.3e-3
    advance_m, aside_m = 0.0, 0.0
    for seq in range(60):
        for step in range(3):
            if seq < 20:
                advance_m += 10e-3 * 1e-9 * STEP_NS
            elif seq < 40:
                advance_m += 0.5e-3 * 1e-9 * STEP_NS
                aside_m += (3e-3 if seq < 30 else -3e-3) * 1e-9 * STEP_NS
            T = np.eye(4)
            T[0, 3], T[2, 3] = aside_m, advance_m
            zero.moved((3 * seq + step) * STEP_NS, T)
        depth_m = max(advance_m - 5.4e-3, 0.0)
        change = 100.0 * depth_m + (60.0 * aside_m if depth_m else 0.0)
        zero.saw((3 * seq + 2) * STEP_NS, seq, change, contact(depth_m + read_m) if depth_m > 0.4e-3 else None)
    assert zero.error_m == pytest.approx(read_m, abs=0.05e-3)


def test_depth_is_not_taken_while_the_sensor_is_shifted_aside_or_sways() -> None:
    """The check after first touch shears the contact, which changes the image as much as depth does."""
    zero, seq, t_ns = TouchZero(), 0, 0

    def frame(advance_m: float, aside_m: float, read_m: float | None) -> None:
        nonlocal seq, t_ns
        T = np.eye(4)
        T[0, 3], T[2, 3] = aside_m, advance_m
        for _ in range(FRAME_NS // STEP_NS):
            t_ns += STEP_NS
            zero.moved(t_ns, T)
        seq += 1
        depth_m = max(advance_m - 5e-3, 0.0)
        change = 0.004 + 90.0 * depth_m * (1.0 + 1.5e3 * aside_m)
        zero.saw(t_ns, seq, change, None if read_m is None else contact(read_m))

    for k in range(20):
        frame(0.33e-3 * k, 0.0, None)
    for k in range(12):
        # Back where it was within the time that is looked at; a model misreads by more meanwhile.
        frame(6.2e-3 + 0.15e-3 * np.sin(2.0 * np.pi * k / 6.0), 0.0, 0.4e-3)
    assert zero.error_m is None
    for k in range(24):
        frame(6.2e-3, 0.15e-3 * (1.0 - np.cos(2.0 * np.pi * (k + 6) / 36.0)), 0.4e-3)
        assert zero.error_m is None
    for _ in range(9):
        frame(6.2e-3, 0.0, 0.9e-3)
    assert zero.error_m == pytest.approx(-0.3e-3, abs=0.07e-3)


def test_depth_is_taken_while_the_sensor_turns_to_face_what_it_touches() -> None:
    zero = TouchZero()
    for seq in range(40):
        T = np.eye(4)
        T[2, 3] = min(0.33e-3 * seq, 6.2e-3)
        angle = np.radians(min(max(seq - 19, 0), 6))
        T[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        for step in range(3):
            zero.moved(seq * FRAME_NS + step * STEP_NS, T)
        depth_m = max(T[2, 3] - 5e-3, 0.0)
        zero.saw(seq * FRAME_NS + 2 * STEP_NS, seq, 0.004 + 90.0 * depth_m, contact(0.9e-3) if depth_m > 0 else None)
    assert zero.error_m == pytest.approx(-0.3e-3, abs=0.07e-3)
