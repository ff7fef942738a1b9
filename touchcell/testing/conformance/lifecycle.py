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
from touchcell.testing.conformance.context import Bench

# ServoArm, which only combines others, is not declared by drivers.
_PROTOCOLS = frozenset(
    protocol
    for protocol in vars(protocols).values()
    if getattr(protocol, "_is_runtime_protocol", False) and len(protocol.__bases__) == 1
)
_WARM_UP_CYCLES = 2
_CYCLES = 10


@check(on_bench=True)
def lifecycle_in_order_only(bench: Bench) -> None:
    """Every operation is refused outside its state, and does not change the state."""
    device = bench.device
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
            device.recover(bench.token)
        assert device.state is before
        getattr(device, step)()
    assert bench.is_in(Lifecycle.READY)
    device.disconnect()
    device.disconnect()
    assert bench.is_in(Lifecycle.DISCONNECTED)


@check("truth")
def connect_never_energises(bench: Bench) -> None:
    """Until ``activate`` no message that changes power, mode or zero is sent, and nothing moves."""
    before = bench.energised()
    start = None if bench.rig.position is None else bench.truth()[bench.rig.position]
    bench.ready()
    bench.sleep(0.2)
    assert bench.energised() == before
    if start is not None:
        np.testing.assert_allclose(bench.truth()[bench.rig.position or ""], start, atol=1e-4)
    bench.device.disconnect()
    assert bench.energised() == before


@check("truth", "process")
def failed_connect_can_be_retried(bench: Bench) -> None:
    """Without a device ``connect`` raises within 15 s, leaves DISCONNECTED, and works once the device is there."""
    bench.seat.clear()
    start_ns = bench.clock.now_ns()
    with pytest.raises(DeviceError):
        bench.device.connect()
    assert (bench.clock.now_ns() - start_ns) * 1e-9 < 15.0
    assert bench.is_in(Lifecycle.DISCONNECTED)
    assert bench.emulator
    bench.active()
    assert bench.is_in(Lifecycle.ACTIVE)


@check(on_bench=True)
def disconnect_from_every_state(bench: Bench) -> None:
    """``disconnect`` works from PASSIVE, READY and ACTIVE, and the device can be used again."""
    steps = ("connect", "configure", "activate")
    for length in range(1, len(steps) + 1):
        for step in steps[:length]:
            getattr(bench.device, step)()
        bench.device.disconnect()
        assert bench.device.state is Lifecycle.DISCONNECTED
        if bench.rig.spec.capabilities.falls_on_power_loss:
            break


@check(on_bench=True)
def protocols_are_those_of_the_record(bench: Bench) -> None:
    """Every protocol that is declared is provided, and every one of ours that is provided is declared."""
    declared = bench.rig.spec.capabilities.provides
    assert {protocol for protocol in declared | _PROTOCOLS if isinstance(bench.device, protocol)} == declared


@check(HealthSource, on_bench=True)
def health_is_told_by_name(bench: Bench) -> None:
    """``health`` returns named numbers and texts while connected; no number is NaN."""
    device = bench.ready()
    assert isinstance(device, HealthSource)
    health = device.health()
    assert health
    for name, reading in health.items():
        assert isinstance(reading, float | int | str | bool), name
        assert reading == reading, name


@check(NativeWatchdog, on_bench=True)
def watchdog_is_read_back(bench: Bench) -> None:
    """An active device reports a watchdog no longer than declared."""
    device = bench.active()
    longest_s = bench.rig.spec.capabilities.max_watchdog_s
    assert isinstance(device, NativeWatchdog)
    assert longest_s is not None
    assert 0.0 < device.watchdog_s() <= longest_s


@check("arm", on_bench=True)
def record_of_the_watchdog_is_consistent(bench: Bench) -> None:
    """``max_watchdog_s`` is declared exactly by devices that have a watchdog."""
    capabilities = bench.rig.spec.capabilities
    assert (capabilities.max_watchdog_s is not None) == (NativeWatchdog in capabilities.provides)


@check(Stoppable)
def stop_categories_are_those_of_the_record(bench: Bench) -> None:
    """Supported categories stop a moving arm in the promised state; the others are refused."""
    offered = bench.rig.spec.capabilities.stop_categories
    assert StopCategory.STOP_AND_HOLD in offered
    lease = bench.leased()
    for category in sorted(StopCategory, reverse=True):
        if category not in offered:
            with pytest.raises(LifecycleError):
                bench.arm.stop(category)
            assert bench.device.state is Lifecycle.ACTIVE
            continue
        bench.stream(lease, bench.twist(bench.axis()), 0.3)
        bench.arm.stop(category)
        if category is StopCategory.STOP_AND_HOLD:
            bench.settle()
            bench.until(bench.arm.at_rest, 1.0, "at_rest")
            assert bench.device.state is Lifecycle.ACTIVE
            continue
        assert bench.device.state is Lifecycle.READY
        if bench.rig.spec.capabilities.has_brakes:
            bench.settle()
        if "energised" in bench.truth():
            bench.until(lambda: not bench.truth()["energised"], 3.0, "power off")
        bench.until(lambda: _activates(bench), 10.0, "ACTIVE after a stop that removes power")
        lease = bench.arm.acquire("after the stop")


def _activates(bench: Bench) -> bool:
    try:
        bench.device.activate()
    except DeviceError:
        return False
    return True


@check(TwistSink)
def deactivation_rests_and_voids_the_lease(bench: Bench) -> None:
    """``deactivate`` of a moving arm ends at rest in READY; the lease is invalid afterwards."""
    lease = bench.leased()
    bench.stream(lease, bench.twist(bench.axis()), 0.3)
    bench.device.deactivate(DeactivatePolicy.HOLD)
    assert bench.device.state is Lifecycle.READY
    before = bench.position()
    bench.sleep(0.2)
    assert np.linalg.norm(bench.position() - before) < 1e-3
    bench.device.activate()
    with pytest.raises(CommandRejected) as caught:
        bench.arm.send_twist(bench.command(bench.twist(bench.axis())), lease)
    assert caught.value.reason is Rejection.LEASE


@check(TwistSink)
def deactivation_policies_are_obeyed_or_refused(bench: Bench) -> None:
    """Each policy ends in READY, or raises LifecycleError and keeps the arm held; power is really off."""
    bench.ready()
    for policy in DeactivatePolicy:
        bench.until(lambda: _activates(bench), 10.0, f"ACTIVE before {policy.value}")
        try:
            bench.device.deactivate(policy)
        except LifecycleError:
            assert policy is not DeactivatePolicy.HOLD
            assert bench.device.state is Lifecycle.ACTIVE
            assert bench.truth().get("energised", True)
            bench.device.deactivate(DeactivatePolicy.HOLD)
            continue
        assert bench.device.state is Lifecycle.READY
        if policy in (DeactivatePolicy.OFF, DeactivatePolicy.PARK_THEN_OFF) and bench.rig.process:
            assert not bench.truth().get("energised", False)


@check("truth")
def ten_cycles_leak_nothing(bench: Bench) -> None:
    """Ten more lifecycles leave no more threads and open files than before."""
    for _ in range(_WARM_UP_CYCLES):
        _cycle(bench)
    before = _threads(), _files()
    for _ in range(_CYCLES):
        _cycle(bench)
    bench.until(lambda: _threads() <= before[0] and _files() <= before[1], 2.0, "threads and files as before")


def _cycle(bench: Bench) -> None:
    bench.active()
    bench.device.disconnect()
    if bench.rig.spec.capabilities.falls_on_power_loss:
        bench.restore()


def _threads() -> int:
    return max(len(os.listdir("/proc/self/task")), threading.active_count())


def _files() -> int:
    return len(os.listdir("/proc/self/fd"))
