"""Health of a cell's devices: read in turn, twice a second, whatever a driver does."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import pytest

from touchcell.cell.runtime.health import PERIOD_S, HealthMonitor
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import TransportTimeout
from touchcell.drivers.core.samples import Stamped

CYCLE_S = 0.01


class Reporting(Device):
    """A device that counts how often it has been asked, and may fail."""

    failure: Exception | None = None
    asked = 0

    def _open(self) -> None: ...

    def _close(self) -> None: ...

    def health(self) -> dict[str, float | int | str | bool]:
        self.asked += 1
        if self.failure is not None:
            raise self.failure
        return {"asked": self.asked}


class Scale(Device):
    """A device that only delivers readings."""

    def _open(self) -> None: ...

    def _close(self) -> None: ...

    def read(self, max_age_s: float | None = None) -> Stamped[Mapping[str, float]]:
        return Stamped({"mass_kg": 2.0}, 0, 1)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


def cycles(monitor: HealthMonitor, clock: VirtualClock, seconds: float) -> list[str]:
    """Return the names of the devices in the order in which they were read."""
    read = []
    for _ in range(round(seconds / CYCLE_S)):
        read += monitor.read()
        clock.advance_s(CYCLE_S)
    return read


def test_all_devices_are_read_first_and_then_one_at_a_time_twice_a_second(clock: VirtualClock) -> None:
    devices = [Reporting(name, clock) for name in ("left", "right")]
    monitor = HealthMonitor(devices, clock)
    assert set(monitor.read()) == {"left", "right"}
    read = cycles(monitor, clock, 10.0)
    assert len(read) == pytest.approx(2 * 10.0 / PERIOD_S, abs=2)
    assert all(one != other for one, other in pairwise(read))
    assert monitor.newest["left"].value == {"asked": devices[0].asked}


def test_a_device_that_cannot_report_now_keeps_its_last_report_and_is_asked_again(clock: VirtualClock) -> None:
    device = Reporting("left", clock)
    monitor = HealthMonitor([device], clock)
    monitor.read()
    before = monitor.newest["left"]
    device.failure = TransportTimeout("left", "reply", 0.1)
    assert cycles(monitor, clock, 2.0) == []
    assert monitor.newest["left"] is before
    device.failure = None
    assert cycles(monitor, clock, 2.0)


def test_a_driver_whose_health_is_broken_is_not_asked_again(clock: VirtualClock) -> None:
    broken, sound = Reporting("left", clock), Reporting("right", clock)
    broken.failure = KeyError("temperature")
    monitor = HealthMonitor([broken, sound], clock)
    assert set(monitor.read()) == {"right"}
    cycles(monitor, clock, 3.0)
    assert broken.asked == 1
    assert sound.asked > 1


def test_readings_of_other_devices_count_as_their_health(clock: VirtualClock) -> None:
    monitor = HealthMonitor([Scale("scale", clock)], clock)
    assert monitor.read()["scale"].value == {"mass_kg": 2.0}
