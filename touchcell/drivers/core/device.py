"""The lifecycle that every device has. Drivers fill in the hooks; the transitions themselves are final.

    DISCONNECTED -connect-> PASSIVE -configure-> READY -activate-> ACTIVE -deactivate-> READY
    any -(fault)-> FAULTED -recover-> READY          any -disconnect-> DISCONNECTED
    DISCONNECTED -connect-> FAULTED, where the device has a fault from before

PASSIVE only reads: nothing that changes power, mode or zero has been sent. ``activate`` alone energises.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from types import TracebackType
from typing import Self, final

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import (
    CommandRejected,
    DeviceError,
    DeviceFault,
    LifecycleError,
    Remedy,
    TransportError,
)

_logger = logging.getLogger(__name__)


class Lifecycle(Enum):
    """State of a device."""

    DISCONNECTED = "disconnected"
    PASSIVE = "passive"
    READY = "ready"
    ACTIVE = "active"
    FAULTED = "faulted"


class DeactivatePolicy(Enum):
    """What an arm does when it is deactivated. The cell file must choose one."""

    HOLD = "hold"
    BRAKE = "brake"
    PARK_THEN_OFF = "park_then_off"
    OFF = "off"


@dataclass(frozen=True, slots=True)
class OperatorToken:
    """Proof that a person asked: made by the command line or a panel, never by a task."""

    operator: str
    t_ns: int


class Device(ABC):
    """A thing that is connected, configured, activated, and given back.

    Args:
        name: the device's name in the cell.
        clock: injected time.

    A hook that raises rolls the transition back: the device is closed and left DISCONNECTED if ``connect`` failed, and
    stays in its former state otherwise. Use it as a context manager to be sure that it is disconnected.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        # Threads of a driver latch faults while the loop's thread makes transitions: state and fault change together.
        self._state_lock = threading.RLock()
        self._state = Lifecycle.DISCONNECTED
        self._fault_error: DeviceError | None = None
        self._configured = False
        self._faults_while_faulted: list[DeviceError] = []

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r}: {self._state.value}>"

    @property
    def state(self) -> Lifecycle:
        """Present lifecycle state."""
        return self._state

    @property
    def fault(self) -> DeviceError | None:
        """What put the device into FAULTED, or None."""
        return self._fault_error

    @final
    def connect(self) -> None:
        """DISCONNECTED -> PASSIVE: open the transport and read. Never changes power, mode or zero.

        A device that has a fault already, such as an arm whose last run was killed, is FAULTED afterwards: ``recover``.
        """
        self._require("connect", Lifecycle.DISCONNECTED)
        self._configured = False
        try:
            self._open()
            found = self._present_fault()
            if found is None:
                self._enter(Lifecycle.PASSIVE)
            else:
                self._to_faulted(found)
        except BaseException:
            self._close()
            self._forget_state()
            raise
        _logger.info("%s: connected", self.name)

    @final
    def configure(self) -> None:
        """PASSIVE -> READY: check and set parameters; nothing is energised."""
        self._require("configure", Lifecycle.PASSIVE)
        self._latching(self._configure)
        self._configured = True
        self._enter(Lifecycle.READY)

    @final
    def activate(self) -> None:
        """READY -> ACTIVE: the only call that energises; the setpoint starts at the present state."""
        self._require("activate", Lifecycle.READY)
        self._latching(self._activate)
        self._enter(Lifecycle.ACTIVE)

    @final
    def deactivate(self, policy: DeactivatePolicy = DeactivatePolicy.HOLD) -> None:
        """ACTIVE -> READY: come to rest, then do as ``policy`` says. From READY it does nothing."""
        if self._state is Lifecycle.READY:
            return
        self._require("deactivate", Lifecycle.ACTIVE)
        self._deactivate(policy)
        self._enter(Lifecycle.READY)

    @final
    def recover(self, token: OperatorToken) -> None:
        """FAULTED -> READY, on a person's request; never on to ACTIVE.

        Raises:
            DeviceError: the cause is still there, or a thread of the driver has latched another fault meanwhile, which
                is then the device's fault.
        """
        with self._state_lock:
            self._require("recover", Lifecycle.FAULTED)
            self._faults_while_faulted.clear()
        self._recover(token)
        if not self._configured:
            # It had its fault before it was configured.
            self._configure()
            self._configured = True
        with self._state_lock:
            self._require("recover", Lifecycle.FAULTED)
            if self._faults_while_faulted:
                self._fault_error = self._faults_while_faulted[0]
                raise self._fault_error
            self._fault_error = None
            self._state = Lifecycle.READY
        _logger.info("%s: recovered on request of %s", self.name, token.operator)

    @final
    def disconnect(self) -> None:
        """Any state -> DISCONNECTED, stopping first if ACTIVE. Never raises for a device that is already gone."""
        if self._state is Lifecycle.DISCONNECTED:
            return
        try:
            if self._state is Lifecycle.ACTIVE:
                # A device that cannot be reached cannot be stopped from here either.
                with suppress(TransportError):
                    self._deactivate(self._disconnect_policy())
        finally:
            self._forget_state()
            self._close()
            _logger.info("%s: disconnected", self.name)

    def __enter__(self) -> Self:
        if self._state is Lifecycle.DISCONNECTED:
            self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()

    def _require(self, operation: str, *allowed: Lifecycle) -> None:
        if self._state not in allowed:
            hint = str(self._fault_error) if self._fault_error else ""
            raise LifecycleError(self.name, operation, self._state.value, [s.value for s in allowed], hint=hint)

    def _enter(self, state: Lifecycle) -> None:
        """Enter ``state``, unless a thread of the driver has latched a fault on the way: then raise that."""
        with self._state_lock:
            if self._fault_error is not None:
                raise self._fault_error
            self._state = state
        _logger.info("%s: %s", self.name, state.value)

    def _change_state(self, expected: Lifecycle, state: Lifecycle) -> bool:
        """Compare and set: enter ``state`` if the device is in ``expected``; returns whether it was."""
        with self._state_lock:
            if self._state is not expected:
                return False
            self._state = state
            return True

    def _forget_state(self) -> None:
        """Be DISCONNECTED, without a fault."""
        with self._state_lock:
            self._state = Lifecycle.DISCONNECTED
            self._fault_error = None

    def _to_faulted(self, error: DeviceError) -> DeviceError:
        """Latch the first fault; returns ``error`` so that callers can raise it.

        A fault latched while the device is FAULTED makes a recovery in progress fail, so a driver's thread reports a
        condition that lasts once only, or only while the device is not FAULTED.
        """
        with self._state_lock:
            if self._state is Lifecycle.FAULTED:
                if not self._faults_while_faulted:
                    self._faults_while_faulted.append(error)
                return error
            # The error first: who reads the state from another thread finds it.
            self._fault_error = error
            self._state = Lifecycle.FAULTED
        _logger.error("faulted: %s", error)
        return error

    def _latching(self, step: Callable[[], None]) -> None:
        """Run a step of a transition; a fault in it that a person can clear by ``recover`` is latched."""
        try:
            step()
        except DeviceFault as error:
            if error.needs is Remedy.RECOVER:
                self._to_faulted(error)
            raise

    def _attempt(self, step: Callable[[], None]) -> None:
        """Run a step and latch FAULTED if the device fails in it; a refused command is no failure."""
        try:
            step()
        except CommandRejected:
            raise
        except DeviceError as error:
            raise self._to_faulted(error) from None

    @abstractmethod
    def _open(self) -> None:
        """Open the transport, read only. Raise ConnectError."""

    @abstractmethod
    def _close(self) -> None:
        """Release everything; called also after a failed ``_open``; must not raise for what was never opened."""

    def _present_fault(self) -> DeviceError | None:
        """Return the fault that the device, just opened, has already and that ``recover`` may clear, or None."""
        return None

    def _configure(self) -> None:
        """Check and set parameters."""

    def _activate(self) -> None:
        """Energise, with the setpoint at the present state."""

    def _deactivate(self, policy: DeactivatePolicy) -> None:
        """Come to rest and obey ``policy``."""

    def _recover(self, token: OperatorToken) -> None:
        """Clear the fault, verify by mode that it is gone."""

    def _disconnect_policy(self) -> DeactivatePolicy:
        """What to do when disconnected while ACTIVE."""
        return DeactivatePolicy.HOLD
