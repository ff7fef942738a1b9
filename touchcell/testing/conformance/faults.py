"""Checks of a driver's reaction to device faults: count them, raise StaleData, or latch FAULTED."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, DeviceError, LifecycleError, StaleData
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import TwistSink
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.context import OWNER, ConformanceContext

_NOTICED_S = 3.0
_CALM_S = 0.25
_RECOVERED_S = 2.0
_RECONNECTED_S = 5.0
_SLOW_M_S = 0.01
_BEYOND_ANY_BUDGET = 2000
_BUDGETED = ("drop", "drop_states", "corrupt", "nan", "error_flag", "out_of_order")
_FROM_BEFORE = ("fault_bits", "hot", "reflex", "user_stop", "protective_stop", "emergency_stop", "bus_off")
_LASTING = ("pause", "unplug")


def _every(fault: str, value: Any, answer: str) -> bool:
    return True


def _counted(fault: str, value: Any, answer: str) -> bool:
    return answer == "transient" and fault in _BUDGETED


def _latching(fault: str, value: Any, answer: str) -> bool:
    # Those that a device still has when the next program connects.
    return answer == "fault" and fault in _FROM_BEFORE


@check("truth", of_faults=_every)
def fault_triggers_expected_reaction(context: ConformanceContext, fault: str) -> None:
    """Each fault of the device fixture has its expected reaction (counted, stale, latched), and is recovered from."""
    value, answer = context.rig.faults[fault]
    context.changed = True
    lease = _begin(context)
    if answer in ("transient", "unseen"):
        _is_tolerated(context, lease, fault, value, counted=answer == "transient")
    elif answer == "stale":
        _becomes_stale(context, fault, value)
    else:
        _is_latched(context, lease, fault, value)


@check("truth", "process", of_faults=_latching)
def starts_beside_a_latched_fault(context: ConformanceContext, fault: str) -> None:
    """A fault from before the connection is an error or FAULTED, never ACTIVE unnoticed; it is recovered from."""
    value, _ = context.rig.faults[fault]
    context.changed = True
    context.ready()
    context.device.disconnect()
    context.begin(fault, value)
    context.sleep(0.2)
    noticed: list[DeviceError] = []

    def notices() -> bool:
        with suppress(DeviceError):
            context.device.disconnect()
        try:
            context.device.connect()
            if context.device.state is Lifecycle.PASSIVE:
                context.device.configure()
                context.device.activate()
                context.sleep(0.2)
                context.read()
        except DeviceError as error:
            noticed.append(error)
        return context.device.state is Lifecycle.FAULTED or bool(noticed)

    context.until(notices, _NOTICED_S, "an error or FAULTED")
    context.end(fault)
    if context.is_in(Lifecycle.FAULTED):
        _serves_again(context)
    else:
        context.reconnect(_RECONNECTED_S)


@check("truth", of_faults=_counted)
def budget_for_transient_faults_ends(context: ConformanceContext, fault: str) -> None:
    """A transient fault that does not end leads to FAULTED with its cause, or to no sample at all."""
    context.changed = True
    lease = _begin(context)
    context.begin(fault, _BEYOND_ANY_BUDGET)
    context.reach_faulted(_NOTICED_S, lease)
    assert isinstance(context.device.fault, DeviceError)
    assert context.device.fault.device == context.device.name


@check("truth", "process")
def vanished_device_is_a_fault_and_can_return(context: ConformanceContext) -> None:
    """kill -9 of the device: FAULTED, ``disconnect`` does not raise, and after its restart everything works again."""
    context.spoiled = True
    lease = _begin(context)
    context.under_test.vanish()
    context.reach_faulted(_NOTICED_S, lease)
    context.device.disconnect()
    assert context.device.state is Lifecycle.DISCONNECTED
    with pytest.raises(DeviceError):
        context.device.connect()
    assert context.device.state is Lifecycle.DISCONNECTED
    assert context.emulator
    context.reconnect()


def _begin(context: ConformanceContext) -> Lease | None:
    """Bring the device to ACTIVE and use it."""
    context.active()
    if TwistSink not in context.rig.spec.capabilities.provides:
        context.until(lambda: _reads(context), 2.0, "first sample")
        return None
    lease = context.arm.acquire(OWNER)
    context.stream(lease, context.twist(context.axis(), speed=_SLOW_M_S), _CALM_S)
    return lease


def _use(context: ConformanceContext, lease: Lease | None, seconds: float) -> list[Any]:
    """Use the device as a task does; return the samples that it gave."""
    samples = []
    end_ns = context.clock.now_ns() + round(seconds * 1e9)
    while context.clock.now_ns() < end_ns:
        if lease is not None:
            with suppress(StaleData):
                context.arm.send_twist(context.command(context.twist(context.axis(), speed=_SLOW_M_S)), lease)
        with suppress(DeviceError):
            samples.append(context.read())
        context.sleep(0.01)
    return samples


def _is_tolerated(context: ConformanceContext, lease: Lease | None, fault: str, value: Any, *, counted: bool) -> None:
    before = context.counters()
    _use(context, lease, _CALM_S)
    calm = context.counters()
    context.begin(fault, value)
    samples = _use(context, lease, 2 * _CALM_S)
    assert context.device.state is Lifecycle.ACTIVE, context.device.fault
    after = context.counters()
    assert len({sample.seq for sample in samples}) > 2
    stamps = [sample.t_ns for sample in samples]
    assert stamps == sorted(stamps)
    if not counted:
        return
    # Counters of normal operation grow most; on a busy machine those of faults are not constant either.
    grown = {name: calm[name] - before.get(name, 0) for name in calm}
    rare = {name for name in after if grown.get(name, 0) <= max(grown.values()) // 2}
    assert any(after[name] > calm.get(name, 0) for name in rare), f"counted nowhere in health: {after}"


def _becomes_stale(context: ConformanceContext, fault: str, value: Any) -> None:
    context.begin(fault, value)
    limit_s = 2.0 / (context.rig.state_rate_hz or context.rig.spec.capabilities.state_rate_hz)
    context.until(lambda: _is_stale(context, limit_s), _NOTICED_S, "StaleData")
    assert context.device.state is not Lifecycle.FAULTED
    context.end(fault)
    context.until(lambda: not _is_stale(context, 10.0 * limit_s), _NOTICED_S, "fresh samples")


def _is_stale(context: ConformanceContext, limit_s: float) -> bool:
    try:
        context.read(limit_s)
    except StaleData:
        return True
    return False


def _is_latched(context: ConformanceContext, lease: Lease | None, fault: str, value: Any) -> None:
    context.begin(fault, value)
    context.reach_faulted(_NOTICED_S, lease)
    first = context.device.fault
    assert isinstance(first, DeviceError)
    assert first.device == context.device.name
    with pytest.raises(LifecycleError):
        context.device.activate()
    if lease is not None:
        with pytest.raises(CommandRejected):
            context.arm.send_twist(context.command(context.twist(context.axis(), speed=_SLOW_M_S)), lease)
        if not context.rig.spec.capabilities.falls_on_power_loss:
            context.settle(3.0)
    context.sleep(0.1)
    assert context.device.state is Lifecycle.FAULTED
    assert context.device.fault is first, "the first fault is the one to report"
    if fault in _LASTING:
        with pytest.raises(DeviceError):
            context.device.recover(context.token)
        assert context.device.state is Lifecycle.FAULTED
    context.end(fault)
    _serves_again(context)
    if lease is not None:
        with pytest.raises(CommandRejected):
            context.arm.send_twist(context.command(context.twist(context.axis(), speed=_SLOW_M_S)), lease)


def _serves_again(context: ConformanceContext) -> None:
    """``recover`` leads to READY, never to ACTIVE; if it cannot, reconnecting does."""
    deadline_ns = context.clock.now_ns() + round(_RECOVERED_S * 1e9)
    while context.is_in(Lifecycle.FAULTED) and context.clock.now_ns() < deadline_ns:
        with suppress(DeviceError):
            context.device.recover(context.token)
            assert context.is_in(Lifecycle.READY)
            assert context.device.fault is None
        context.sleep(0.05)
    if context.is_in(Lifecycle.READY):
        with suppress(DeviceError):
            context.device.activate()
    if not context.is_in(Lifecycle.ACTIVE):
        if context.rig.spec.capabilities.falls_on_power_loss:
            # It fell; it has to be lifted.
            context.device.disconnect()
            context.restore()
        context.reconnect(_RECONNECTED_S)


def _reads(context: ConformanceContext) -> bool:
    with suppress(DeviceError):
        context.read()
        return True
    return False
