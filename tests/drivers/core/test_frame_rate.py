from __future__ import annotations

import pytest

from touchcell.drivers.core.frame_rate import FrameRate


def after(rate: FrameRate, periods: list[float]) -> FrameRate:
    for period_s in periods:
        rate.note(period_s, 1)
    return rate


def test_a_rate_as_promised_with_jitter_is_no_fault() -> None:
    rate = after(FrameRate(60.0), [1 / 60 + 0.004 * (-1) ** n for n in range(300)])
    assert not rate.is_broken
    assert rate.measured_hz == pytest.approx(60.0, rel=0.01)


@pytest.mark.parametrize("true_hz", [8.0, 16.0, 20.0, 32.5, 53.0, 70.0])
@pytest.mark.parametrize("promised_hz", [30.0, 60.0])
def test_a_camera_that_changes_its_rate_is_found_within_three_seconds(true_hz: float, promised_hz: float) -> None:
    true_hz *= promised_hz / 60.0
    rate = after(FrameRate(promised_hz), [1 / promised_hz] * 1000)
    assert not rate.is_broken
    assert after(rate, [1 / true_hz] * int(3.0 * true_hz)).is_broken


def test_a_busy_moment_is_no_fault_while_it_lasts() -> None:
    rate = after(FrameRate(60.0), [1 / 60] * 317)
    for _ in range(40):
        assert not after(rate, [2.5 / 60]).is_broken


def test_every_third_frame_missing_without_a_gap_in_the_numbers_is_a_fault() -> None:
    assert after(FrameRate(60.0), [1 / 60, 2 / 60] * 60).is_broken


def test_lost_frames_that_the_numbers_tell_are_no_fault_of_the_rate() -> None:
    rate = FrameRate(60.0)
    for frames in [1, 2, 3] * 60:
        rate.note(frames / 60.0, frames)
    assert not rate.is_broken


def test_a_stall_is_no_fault_of_the_rate() -> None:
    assert not after(FrameRate(60.0), [1 / 60] * 59 + [1.5] + [1 / 60] * 59).is_broken


def test_a_moment_in_which_the_machine_is_busy_is_no_fault() -> None:
    assert not after(FrameRate(60.0), [1 / 60] * 60 + [2.5 / 60] * 40 + [1 / 60] * 60).is_broken
