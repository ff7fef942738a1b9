"""Checks of connecting, configuring, energising and releasing."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest

from touchcell.drivers.core import protocols
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle
from touchcell.drivers.core.errors import CommandRejected, DeviceError, LifecycleError, Rejection
from touchcell.drivers.core.protocols import HealthSource, NativeWatchdog, StopCategory, Stoppable, TwistSink
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.context import ConformanceContext

# ServoArm, which only combines others, is not declared by drivers.
_PROTOCOLS = frozenset(
    protocol
    for protocol in vars(protocols).values()
    if getattr(protocol, "_is_runtime_protocol", False) and len(protocol.__bases__) == 1
)
_WARM_UP_CYCLES = 2
_CYCLES = 10


@check(on_hardware=True)
def lifecycle_in_order_only(context: ConformanceContext) -> None:
    """Every operation is refused outside its state, and does not change the state."""
    device = context.device
    allowed = {
        "connect": (Lifecycle.DISCONNECTED,),
        "configure": (Lifecycle.PASSIVE,),
        "activate": (Lifecycle.READY,),
        "deactivate": (Lifecycle.ACTIVE, Lifecycle.READY),
    }
    for step in ("connect", "configure", "activate", "deactivate"):
        before = device.state
        for operation, states in allowed.items():
            if before not in states:
                with pytest.raises(LifecycleError):
                    getattr(device, operation)()
        with pytest.raises(LifecycleError):
            device.recover(context.token)
        assert device.state is before
        getattr(device, step)()
    assert context.is_in(Lifecycle.READY)
    device.disconnect()
    device.disconnect()
    assert context.is_in(Lifecycle.DISCONNECTED)


@check("truth")
def connect_never_energises(context: ConformanceContext) -> None:
    """Until ``activate`` no message that changes power, mode or zero is sent, and nothing moves."""
    before = context.energised()
    start = None if context.rig.position is None else context.truth()[context.rig.position]
    context.ready()
    context.sleep(0.2)
    assert context.energised() == before
    if start is not None:
        np.testing.assert_allclose(context.truth()[context.rig.position or ""], start, atol=1e-4)
    context.device.disconnect()
    assert context.energised() == before


@check("truth", "process")
def failed_connect_can_be_retried(context: ConformanceContext) -> None:
    """Without a device ``connect`` raises within 15 s, leaves DISCONNECTED, and works once the device is available."""
    context.under_test.clear()
    start_ns = context.clock.now_ns()
    with pytest.raises(DeviceError):
        context.device.connect()
    assert (context.clock.now_ns() - start_ns) * 1e-9 < 15.0
    assert context.is_in(Lifecycle.DISCONNECTED)
    assert context.emulator
    context.active()
    assert context.is_in(Lifecycle.ACTIVE)


@check(on_hardware=True)
def disconnect_from_every_state(context: ConformanceContext) -> None:
    """``disconnect`` works from PASSIVE, READY and ACTIVE, and the device can be used again."""
    steps = ("connect", "configure", "activate")
    for length in range(1, len(steps) + 1):
        for step in steps[:length]:
            getattr(context.device, step)()
        context.device.disconnect()
        assert context.device.state is Lifecycle.DISCONNECTED
        if context.rig.spec.capabilities.falls_on_power_loss:
            break


@check(on_hardware=True)
def protocols_are_those_of_the_record(context: ConformanceContext) -> None:
    """Every protocol that is declared is provided, and every one of ours that is provided is declared."""
    declared = context.rig.spec.capabilities.provides
    assert {protocol for protocol in declared | _PROTOCOLS if isinstance(context.device, protocol)} == declared


@check(HealthSource, on_hardware=True)
def health_has_named_readings(context: ConformanceContext) -> None:
    """``health`` returns named numbers and texts while connected; no number is NaN."""
    device = context.ready()
    assert isinstance(device, HealthSource)
    health = device.health()
    assert health
    for name, reading in health.items():
        assert isinstance(reading, float | int | str | bool), name
        assert reading == reading, name


@check(NativeWatchdog, on_hardware=True)
def watchdog_is_read_back(context: ConformanceContext) -> None:
    """An active device reports a watchdog no longer than declared."""
    device = context.active()
    longest_s = context.rig.spec.capabilities.max_watchdog_s
    assert isinstance(device, NativeWatchdog)
    assert longest_s is not None
    assert 0.0 < device.watchdog_s() <= longest_s


@check("arm", on_hardware=True)
def record_of_the_watchdog_is_consistent(context: ConformanceContext) -> None:
    """``max_watchdog_s`` is declared exactly by devices that have a watchdog."""
    capabilities = context.rig.spec.capabilities
    assert (capabilities.max_watchdog_s is not None) == (NativeWatchdog in capabilities.provides)


@check(Stoppable)
def stop_categories_are_those_of_the_record(context: ConformanceContext) -> None:
    """Supported categories stop a moving arm in the promised state; the others are refused."""
    offered = context.rig.spec.capabilities.stop_categories
    assert StopCategory.STOP_AND_HOLD in offered
    lease = context.leased()
    for category in sorted(StopCategory, reverse=True):
        if category not in offered:
            with pytest.raises(LifecycleError):
                context.arm.stop(category)
            assert context.device.state is Lifecycle.ACTIVE
            continue
        context.stream(lease, context.twist(context.axis()), 0.3)
        context.arm.stop(category)
        if category is StopCategory.STOP_AND_HOLD:
            context.settle()
            context.until(context.arm.at_rest, 1.0, "at_rest")
            assert context.device.state is Lifecycle.ACTIVE
            continue
        assert context.device.state is Lifecycle.READY
        if context.rig.spec.capabilities.has_brakes:
            context.settle()
        if "energised" in context.truth():
            context.until(lambda: not context.truth()["energised"], 3.0, "power off")
        context.until(lambda: _activates(context), 10.0, "ACTIVE after a stop that removes power")
        lease = context.arm.acquire("after the stop")


def _activates(context: ConformanceContext) -> bool:
    try:
        context.device.activate()
    except DeviceError:
        return False
    return True


@check(TwistSink)
def deactivation_stops_and_voids_the_lease(context: ConformanceContext) -> None:
    """``deactivate`` of a moving arm ends at rest in READY; the lease is invalid afterwards."""
    lease = context.leased()
    context.stream(lease, context.twist(context.axis()), 0.3)
    context.device.deactivate(DeactivatePolicy.HOLD)
    assert context.device.state is Lifecycle.READY
    before = context.position()
    context.sleep(0.2)
    assert np.linalg.norm(context.position() - before) < 1e-3
    context.device.activate()
    with pytest.raises(CommandRejected) as caught:
        context.arm.send_twist(context.command(context.twist(context.axis())), lease)
    assert caught.value.reason is Rejection.LEASE


@check(TwistSink)
def deactivation_policies_are_applied_or_refused(context: ConformanceContext) -> None:
    """Each policy ends in READY, or raises LifecycleError and keeps the arm held; power is really off."""
    context.ready()
    for policy in DeactivatePolicy:
        context.until(lambda: _activates(context), 10.0, f"ACTIVE before {policy.value}")
        try:
            context.device.deactivate(policy)
        except LifecycleError:
            assert policy is not DeactivatePolicy.HOLD
            assert context.device.state is Lifecycle.ACTIVE
            assert context.truth().get("energised", True)
            context.device.deactivate(DeactivatePolicy.HOLD)
            continue
        assert context.device.state is Lifecycle.READY
        if policy in (DeactivatePolicy.OFF, DeactivatePolicy.PARK_THEN_OFF) and context.rig.process:
            assert not context.truth().get("energised", False)


@check("truth")
def ten_cycles_leak_nothing(context: ConformanceContext) -> None:
    """Ten more lifecycles leave no more threads and open files than before."""
    for _ in range(_WARM_UP_CYCLES):
        _cycle(context)
    before = _threads(), _files()
    for _ in range(_CYCLES):
        _cycle(context)
    context.until(lambda: _threads() <= before[0] and _files() <= before[1], 2.0, "threads and files as before")


def _cycle(context: ConformanceContext) -> None:
    context.active()
    context.device.disconnect()
    if context.rig.spec.capabilities.falls_on_power_loss:
        context.restore()


def _threads() -> int:
    return max(len(os.listdir("/proc/self/task")), threading.active_count())


def _files() -> int:
    return len(os.listdir("/proc/self/fd"))
