"""Reset of a run that has tripped: what the operator may ask of it. A reset moves nothing, only resuming does."""

from __future__ import annotations

from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest, Request
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.latch import LatchState, ResetDone
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.lease import Lease


class ResetProcedure:
    """From a trip until the task starts again.

    Args:
        cell: whose latch is to be reset.
        leases: of the arms that the task moves, by role, renewed where a stop has voided them.
        channel: where the operator asks.

    Attributes:
        resets: what has been cleared, and by whom.
    """

    def __init__(self, cell: Cell, leases: dict[str, Lease], channel: OperatorChannel) -> None:
        self._cell = cell
        self._leases = leases
        self._channel = channel
        self.resets: list[ResetDone] = []

    def describe(self) -> str:
        """What the operator has to know now, in one line."""
        latch = self._cell.supervisor.latch
        if (cause := latch.first_cause) is None:
            return "reset; `touchcell resume` or g starts the task from its beginning"
        state = "r resets" if latch.state is LatchState.CAUSE_GONE else "the cause is still there"
        return f"{cause.interlock}: {cause.subject}: {cause.reason}; {state}"

    def answer(self, view: CellView | None) -> tuple[bool, list[str]]:
        """Answer everything that has been asked; returns whether the task is to start again, and what was done.

        Args:
            view: the cell now; None where a device does not answer, which no reset gets over.
        """
        done_so_far = []
        while (request := self._channel.take()) is not None:
            done, words = self._reset(request, view) if request.ask is OperatorRequest.RESET else self._resume()
            self._channel.answer(request, done, words)
            done_so_far.append(f"{request.ask.value} by {request.operator}: {words}")
            if done and request.ask is OperatorRequest.RESUME:
                return True, done_so_far
        return False, done_so_far

    def _reset(self, request: Request, view: CellView | None) -> tuple[bool, str]:
        token = OperatorToken(request.operator, self._cell.clock.now_ns())
        try:
            for device in self._devices():
                if device.state is Lifecycle.FAULTED:
                    device.recover(token)
        except DeviceError as error:
            return False, f"refused: {error}"
        if view is None:
            return False, "refused: a device does not answer yet; if it has just been recovered, ask again"
        supervisor = self._cell.supervisor
        if supervisor.latch.state is LatchState.CAUSE_GONE:
            try:
                # A host forgets its stop only for an arm that nobody holds.
                for role, lease in self._leases.items():
                    self._cell.arms[role].release(lease)
                self._cell.watchdog.clear()
            except DeviceError as error:
                return False, f"refused: {error}"
        outcome = supervisor.reset(token, view, self._cell.watchdog.alarms(view.now_ns))
        if not isinstance(outcome, ResetDone):
            return False, f"refused: {outcome.reason.value}"
        self.resets.append(outcome)
        return True, "reset; nothing moves until `touchcell resume`"

    def _resume(self) -> tuple[bool, str]:
        if self._cell.supervisor.latch.state is not LatchState.CLEAR:
            return False, "refused: reset first"
        try:
            for device in self._devices():
                if device.state is Lifecycle.READY:
                    device.activate()
            for role in self._leases:
                if self._cell.arms[role].owner is None:
                    self._leases[role] = self._cell.arms[role].acquire(self._cell.task_name)
            self._cell.watchdog.begin()
        except DeviceError as error:
            return False, f"refused: {error}"
        return True, "the task starts again from its first state"

    def _devices(self) -> list[Device]:
        cell = self._cell
        return [*cell.arms.values(), *cell.cameras.values(), *cell.auxiliaries.values()]
