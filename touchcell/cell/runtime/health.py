"""What devices report about themselves, read at a low rate beside the control cycle.

Temperatures, voltages, error counters and true rates change slowly and cost a round trip each, so one device is asked
at a time and each twice a second.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Final

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.protocols import HealthSource, ReadingSource
from touchcell.drivers.core.samples import Health, Stamped
from touchcell.errors import TouchcellError

_logger = logging.getLogger(__name__)

PERIOD_S: Final = 0.5
"""Time from one reading of a device to the next."""


class HealthMonitor:
    """Reads ``health`` of a cell's devices in turn, and the newest numbers of those that deliver readings.

    Args:
        devices: of the cell.
        clock: its time.

    Attributes:
        newest: latest health by the device's name; devices that have not answered yet are missing.
    """

    def __init__(self, devices: Iterable[Device], clock: Clock) -> None:
        self._devices: list[Device] = [device for device in devices if isinstance(device, HealthSource | ReadingSource)]
        self._clock = clock
        self._next = 0
        self._due_ns = 0
        self._started = False
        self.newest: dict[str, Stamped[Health]] = {}

    def read(self) -> Mapping[str, Stamped[Health]]:
        """Read the device whose turn it is, in the first call all of them; return what is new, by the device's name.

        Never raises: a device that fails is found by those who command it.
        """
        if not self._devices:
            return {}
        if not self._started:
            self._started = True
            self._due_ns = self._clock.now_ns() + self._interval_ns
            return self._read(self._devices)
        if self._clock.now_ns() < self._due_ns:
            return {}
        self._due_ns = max(self._due_ns + self._interval_ns, self._clock.now_ns())
        self._next = (self._next + 1) % len(self._devices)
        return self._read([self._devices[self._next]])

    @property
    def _interval_ns(self) -> int:
        return round(1e9 * PERIOD_S / len(self._devices))

    def _read(self, devices: Iterable[Device]) -> dict[str, Stamped[Health]]:
        found: dict[str, Stamped[Health]] = {}
        for device in list(devices):
            try:
                health = health_of(device)
            except TouchcellError as error:
                _logger.info("%s: no health: %s", device.name, error)
                continue
            except BaseException:
                _logger.exception("%s: its driver failed to report its health, and is not asked again", device.name)
                self._devices.remove(device)
                continue
            before = self.newest.get(device.name)
            sample = Stamped(health, self._clock.now_ns(), 1 if before is None else before.seq + 1)
            self.newest[device.name] = found[device.name] = sample
        return found


def health_of(device: Device) -> Health:
    """Return what a device reports about itself, with its newest readings if it delivers any. Raises DeviceError."""
    health: dict[str, float | int | str | bool] = {}
    if isinstance(device, HealthSource):
        health |= device.health()
    if isinstance(device, ReadingSource):
        health |= device.read().value
    return health
