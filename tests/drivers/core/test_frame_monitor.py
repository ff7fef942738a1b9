"""The bookkeeping of a frame stream."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.frame_monitor import FrameMonitor


def test_counts_lost_frames_and_their_cause() -> None:
    watch = FrameMonitor()
    watch.miss(2, overrun=False)
    watch.miss(5, overrun=True)
    readings = watch.readings()
    assert (readings["frames_lost"], readings["frames_unread"]) == (2, 5)


def test_identical_bytes_are_frozen_until_they_change() -> None:
    watch = FrameMonitor()
    for data in (b"a", b"b", b"b", b"b"):
        watch.admit(data)
    assert (watch.frozen, watch.frozen_run) == (2, 2)
    watch.admit(b"c")
    assert (watch.frozen, watch.frozen_run) == (2, 0)


def test_raw_frames_that_differ_only_in_noise_at_their_centre_are_not_frozen() -> None:
    watch = FrameMonitor()
    generator = np.random.default_rng(0)
    for _ in range(5):
        frame = np.zeros((480, 640, 2), np.uint8)
        frame[100:380, 100:540, 0] = generator.integers(100, 103, (280, 440), np.uint8)
        watch.admit(frame.tobytes())
    assert watch.frozen == 0


def test_the_budget_is_ten_bad_frames_in_thirty() -> None:
    watch = FrameMonitor()
    for number in range(10):
        watch.refuse("damaged")
        watch.admit(bytes([number]))
    assert not watch.out_of_budget
    watch.refuse("damaged")
    assert watch.out_of_budget
    for number in range(30):
        watch.admit(bytes([number]))
    assert not watch.out_of_budget
    assert watch.readings()["frames_bad_damaged"] == 11


def test_brightness_is_compared_with_the_first_sixty_frames() -> None:
    watch = FrameMonitor()
    for _ in range(60):
        watch.look(np.full((48, 64), 100, np.uint8))
    assert watch.readings()["brightness_drift"] == 0.0
    for _ in range(200):
        watch.look(np.full((48, 64), 150, np.uint8))
    drift = watch.readings()["brightness_drift"]
    assert isinstance(drift, float)
    assert abs(drift - 0.5) < 1e-6
