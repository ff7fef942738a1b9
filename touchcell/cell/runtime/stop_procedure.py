"""What stops a run's arms and other devices: all are commanded in the same moment, and each is watched to rest."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Final

from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.observer import call_driver
from touchcell.cell.runtime.run_record import RunRecord
from touchcell.cell.runtime.stopping import Stopper, StopReport
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.protocols import ServoArm, Stoppable
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import TouchcellError, described

logger = logging.getLogger(__name__)

DEVICE_REST_S: Final = 2.0
"""The time within which a device that is no arm has to be at rest after a stop: unlike an arm it declares none."""


class StopProcedure:
    """Stops the moved arms of a cell, records how they come to rest, and latches what does not.

    Args:
        cell: activated.
        arms: that the run moves, by role.
        record: of the run.
    """

    def __init__(self, cell: Cell, arms: Mapping[str, ServoArm], record: RunRecord) -> None:
        self._cell = cell
        self._arms = arms
        self._record = record
        self._stopper = Stopper(arms, cell.stop_categories, cell.clock, 1.0 / cell.rate_hz, cell.holding)
        self._devices: dict[str, Stoppable] = {}
        self._devices_deadline_ns = 0

    def begin(self, *, tripped: bool) -> None:
        """Command all arms to stop: as the cell file says when something is wrong, else holding where they are.

        Other devices that can be stopped then stop and hold.
        """
        distrusted = {c.subject for c in self._cell.supervisor.latch.causes if c.severity is Severity.FAULT}
        failed = self._stopper.stop(tripped=tripped, distrusted=distrusted)
        for role, error in failed.items():
            logger.error("%s could not be told to stop", role, exc_info=error)
            self._record.event(
                "stop failed", f"{role}: {error if isinstance(error, TouchcellError) else described(error)}"
            )
        self._devices_deadline_ns = self._cell.clock.now_ns() + round(1e9 * DEVICE_REST_S)
        for role, device in self._cell.auxiliaries.items():
            if isinstance(device, Stoppable):
                self._devices[role] = device
                try:
                    call_driver(device.name, device.stop)
                except (DeviceError, KeyboardInterrupt) as error:
                    self._record.event("stop failed", f"{role}: {error}")

    def await_rest(self) -> Mapping[str, StopReport]:
        """Watch the arms, then the other devices that were commanded to stop, until they stand."""
        stops = self._stopper.watch(self._on_state, self._on_escalation)
        for role, report in stops.items():
            if report.problem:
                self._record.event("stop failed", f"{role}: {report.problem}")
        self._await_devices()
        return stops

    def _await_devices(self) -> None:
        clock = self._cell.clock
        while moving := {role: why for role, device in self._devices.items() if (why := _unrest(device))}:
            if clock.now_ns() >= self._devices_deadline_ns:
                for role, why in moving.items():
                    self._distrust(role, why)
                break
            self._beat()
            clock.sleep_until_ns(clock.now_ns() + round(1e9 / self._cell.rate_hz))
        self._devices.clear()

    def _distrust(self, role: str, why: str) -> None:
        """Latch a device that is not seen at rest: it has no stronger stop."""
        reason = f"{why} {DEVICE_REST_S:g} s after a stop"
        now_ns = self._cell.clock.now_ns()
        self._cell.supervisor.latch.update([Violation("stop", Severity.FAULT, role, reason, now_ns)])
        self._record.event("stop failed", f"{role}: {reason}: use the emergency stop")

    def _on_state(self, role: str, state: Stamped[TcpState]) -> None:
        self._beat()
        self._record.state(role, state)

    def _beat(self) -> None:
        try:
            # What is on its way to rest is still guarded.
            self._cell.watchdog.beat()
        except BaseException:
            logger.exception("the watchdog was not told that the loop lives")

    def _on_escalation(self, role: str, report: StopReport, waited_s: float) -> None:
        reason = f"not seen at rest {waited_s:.3f} s after a stop by category {int(report.category)}"
        now_ns = self._cell.clock.now_ns()
        self._cell.supervisor.latch.update(
            [Violation("stop", Severity.FAULT, role, reason, now_ns, value=waited_s, limit=report.declared_s, unit="s")]
        )
        self._record.event("escalated", f"{role}: {reason}")


def _unrest(device: Stoppable) -> str:
    """Return why a device is not known to be at rest; "" if it is."""
    try:
        return "" if device.at_rest() else "still moves"
    except BaseException as error:
        return f"is not seen at rest ({described(error)})"
