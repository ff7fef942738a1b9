"""The bookkeeping of a frame stream."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.frame_monitor import FrameMonitor


def test_counts_lost_frames_and_their_cause() -> None:
    monitor = FrameMonitor()
    monitor.count_lost(2, overrun=False)
    monitor.count_lost(5, overrun=True)
    readings = monitor.readings()
    assert (readings["frames_lost"], readings["frames_unread"]) == (2, 5)


def test_identical_bytes_are_frozen_until_they_change() -> None:
    monitor = FrameMonitor()
    for data in (b"a", b"b", b"b", b"b"):
        monitor.count_good(data)
    assert (monitor.frozen, monitor.frozen_run) == (2, 2)
    monitor.count_good(b"c")
    assert (monitor.frozen, monitor.frozen_run) == (2, 0)


def test_raw_frames_that_differ_only_in_noise_at_their_centre_are_not_frozen() -> None:
    monitor = FrameMonitor()
    generator = np.random.default_rng(0)
    for _ in range(5):
        frame = np.zeros((480, 640, 2), np.uint8)
        frame[100:380, 100:540, 0] = generator.integers(100, 103, (280, 440), np.uint8)
        monitor.count_good(frame.tobytes())
    assert monitor.frozen == 0


def test_the_budget_is_ten_bad_frames_in_thirty() -> None:
    monitor = FrameMonitor()
    for number in range(10):
        monitor.count_bad("damaged")
        monitor.count_good(bytes([number]))
    assert not monitor.has_too_many_bad
    monitor.count_bad("damaged")
    assert monitor.has_too_many_bad
    for number in range(30):
        monitor.count_good(bytes([number]))
    assert not monitor.has_too_many_bad
    assert monitor.readings()["frames_bad_damaged"] == 11


def test_brightness_is_compared_with_the_first_sixty_frames() -> None:
    monitor = FrameMonitor()
    for _ in range(60):
        monitor.record_brightness(np.full((48, 64), 100, np.uint8))
    assert monitor.readings()["brightness_drift"] == 0.0
    for _ in range(200):
        monitor.record_brightness(np.full((48, 64), 150, np.uint8))
    drift = monitor.readings()["brightness_drift"]
    assert isinstance(drift, float)
    assert abs(drift - 0.5) < 1e-6
