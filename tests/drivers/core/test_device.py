"""Faults latched by a driver's own thread, lost devices, and refusals that are not faults."""

from __future__ import annotations

import threading

import pytest

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.device import DeactivatePolicy, Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import (
    CommandRejected,
    DeviceError,
    DeviceFault,
    DeviceGone,
    LifecycleError,
    Rejection,
    Remedy,
)


class Gadget(Device):
    """Driver with behaviour set by each test."""

    def __init__(self) -> None:
        super().__init__("gadget", VirtualClock())
        self.latch_on_the_way: DeviceError | None = None
        self.raise_at_rest: DeviceError | None = None
        self.has_fault: DeviceError | None = None
        self.raise_in_configure: DeviceError | None = None
        self.configured = 0

    def _open(self) -> None: ...

    def _close(self) -> None: ...

    def _present_fault(self) -> DeviceError | None:
        return self.has_fault

    def _configure(self) -> None:
        if self.raise_in_configure is not None:
            raise self.raise_in_configure
        self.configured += 1

    def _activate(self) -> None:
        if self.latch_on_the_way is not None:
            self._to_faulted(self.latch_on_the_way)

    def _recover(self, token: OperatorToken) -> None:
        if self.has_fault is not None:
            raise self.has_fault
        if self.latch_on_the_way is not None:
            thread = threading.Thread(target=self._to_faulted, args=(self.latch_on_the_way,))
            thread.start()
            thread.join()

    def _deactivate(self, policy: DeactivatePolicy) -> None:
        if self.raise_at_rest is not None:
            raise self.raise_at_rest

    def attempt(self, error: DeviceError) -> None:
        def step() -> None:
            raise error

        self._attempt(step)


@pytest.fixture
def gadget() -> Gadget:
    """A gadget in READY."""
    made = Gadget()
    made.connect()
    made.configure()
    return made


def test_a_fault_latched_during_activation_is_not_overwritten(gadget: Gadget) -> None:
    gadget.latch_on_the_way = DeviceFault("gadget", "hot")
    with pytest.raises(DeviceFault, match="hot"):
        gadget.activate()
    assert gadget.state is Lifecycle.FAULTED
    assert gadget.fault is gadget.latch_on_the_way


def test_disconnecting_a_lost_device_does_not_raise(gadget: Gadget) -> None:
    gadget.activate()
    gadget.raise_at_rest = DeviceGone("gadget", "cable")
    gadget.disconnect()
    assert gadget.state is Lifecycle.DISCONNECTED


def test_disconnecting_a_device_that_does_not_come_to_rest_raises(gadget: Gadget) -> None:
    gadget.activate()
    gadget.raise_at_rest = DeviceFault("gadget", "still moving")
    with pytest.raises(DeviceFault, match="still moving"):
        gadget.disconnect()
    assert gadget.state is Lifecycle.DISCONNECTED


def test_a_rejected_command_is_not_a_fault_but_a_lost_device_is(gadget: Gadget) -> None:
    with pytest.raises(CommandRejected):
        gadget.attempt(CommandRejected("gadget", Rejection.MODE, "busy"))
    assert gadget.state is Lifecycle.READY
    with pytest.raises(DeviceGone):
        gadget.attempt(DeviceGone("gadget", "cable"))
    assert gadget.state is Lifecycle.FAULTED


def test_a_fault_latched_while_connecting_leaves_the_device_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    gadget = Gadget()
    monkeypatch.setattr(gadget, "_open", lambda: gadget._to_faulted(DeviceFault("gadget", "hot")))
    with pytest.raises(DeviceFault, match="hot"):
        gadget.connect()
    assert gadget.state is Lifecycle.DISCONNECTED
    assert gadget.fault is None


def test_a_connection_that_fails_with_a_fault_leaves_the_device_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    gadget = Gadget()
    monkeypatch.setattr(gadget, "_open", lambda: gadget.attempt(DeviceGone("gadget", "cable")))
    with pytest.raises(DeviceGone):
        gadget.connect()
    assert gadget.state is Lifecycle.DISCONNECTED
    assert gadget.fault is None


class Interrupted:
    """A lock that lets another thread latch a fault in the last moment before it is taken."""

    def __init__(self, device: Device, fault: DeviceError) -> None:
        self._lock, self._device, self._fault = device._state_lock, device, fault
        self._pending = True

    def __enter__(self) -> None:
        if self._pending:
            self._pending = False
            thread = threading.Thread(target=self._device._to_faulted, args=(self._fault,))
            thread.start()
            thread.join()
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


@pytest.mark.parametrize("transition", ["activate", "deactivate"])
def test_no_transition_overwrites_a_fault_of_the_last_moment(gadget: Gadget, transition: str) -> None:
    if transition == "deactivate":
        gadget.activate()
    fault = DeviceFault("gadget", "hot")
    gadget._state_lock = Interrupted(gadget, fault)  # type: ignore[assignment]
    with pytest.raises(DeviceFault, match="hot"):
        getattr(gadget, transition)()
    assert gadget.state is Lifecycle.FAULTED
    assert gadget.fault is fault


def test_a_device_with_a_fault_from_before_is_faulted_once_connected_and_configured_by_recovery() -> None:
    gadget = Gadget()
    gadget.has_fault = DeviceFault("gadget", "stopped by its watchdog")
    gadget.connect()
    assert (gadget.state, gadget.fault) == (Lifecycle.FAULTED, gadget.has_fault)
    with pytest.raises(LifecycleError, match="stopped by its watchdog"):
        gadget.configure()
    with pytest.raises(DeviceFault):
        gadget.recover(OperatorToken("test", 0))
    gadget.has_fault = None
    gadget.recover(OperatorToken("test", 0))
    assert (gadget.state, gadget.configured) == (Lifecycle.READY, 1)
    gadget.activate()
    assert gadget.state is Lifecycle.ACTIVE


@pytest.mark.parametrize(
    ("needs", "state"), [(Remedy.RECOVER, Lifecycle.FAULTED), (Remedy.OPERATOR, Lifecycle.PASSIVE)]
)
def test_a_fault_found_by_configuring_is_latched_if_recovery_can_clear_it(needs: Remedy, state: Lifecycle) -> None:
    gadget = Gadget()
    gadget.connect()
    gadget.raise_in_configure = DeviceFault("gadget", "protective stop", needs=needs)
    with pytest.raises(DeviceFault, match="protective stop"):
        gadget.configure()
    assert gadget.state is state


def test_a_fault_latched_by_another_thread_during_recovery_keeps_the_device_faulted(gadget: Gadget) -> None:
    first, second = DeviceFault("gadget", "hot"), DeviceFault("gadget", "encoder")
    gadget._to_faulted(first)
    assert gadget.fault is first
    gadget.latch_on_the_way = second
    with pytest.raises(DeviceFault, match="encoder"):
        gadget.recover(OperatorToken("anna", 1))
    assert (gadget.state, gadget.fault) == (Lifecycle.FAULTED, second)
    gadget.latch_on_the_way = None
    gadget.recover(OperatorToken("anna", 2))
    assert (gadget.state, gadget.fault) == (Lifecycle.READY, None)


def test_a_fault_latched_in_the_last_moment_of_a_recovery_is_not_overwritten(gadget: Gadget) -> None:
    gadget._to_faulted(DeviceFault("gadget", "hot"))
    second = DeviceFault("gadget", "encoder")
    recover = gadget._recover

    def interrupt(token: OperatorToken) -> None:
        recover(token)
        gadget._state_lock = Interrupted(gadget, second)  # type: ignore[assignment]

    gadget._recover = interrupt  # type: ignore[method-assign]
    with pytest.raises(DeviceFault, match="encoder"):
        gadget.recover(OperatorToken("anna", 1))
    assert (gadget.state, gadget.fault) == (Lifecycle.FAULTED, second)


def test_a_second_fault_before_a_recovery_does_not_make_it_fail(gadget: Gadget) -> None:
    gadget._to_faulted(DeviceFault("gadget", "hot"))
    gadget._to_faulted(DeviceFault("gadget", "hotter"))
    gadget.recover(OperatorToken("anna", 1))
    assert gadget.state is Lifecycle.READY
