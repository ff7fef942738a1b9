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
from touchcell.testing.conformance.context import OWNER, Bench

_NOTICED_S = 3.0
_CALM_S = 0.25
_RECOVERED_S = 2.0
_RECONNECTED_S = 5.0
_SLOW_M_S = 0.01
_BEYOND_ANY_BUDGET = 2000
_BUDGETED = ("drop", "drop_states", "corrupt", "nan", "error_flag", "out_of_order")
_LASTING = ("pause", "unplug")


def _every(fault: str, value: Any, answer: str) -> bool:
    return True


def _counted(fault: str, value: Any, answer: str) -> bool:
    return answer == "transient" and fault in _BUDGETED


@check("truth", of_faults=_every)
def fault_triggers_expected_reaction(bench: Bench, fault: str) -> None:
    """Each fault of the device fixture has its expected reaction (counted, stale, latched), and is recovered from."""
    value, answer = bench.rig.faults[fault]
    bench.changed = True
    lease = _begin(bench)
    if answer in ("transient", "unseen"):
        _is_survived(bench, lease, fault, value, counted=answer == "transient")
    elif answer == "stale":
        _is_called_stale(bench, fault, value)
    else:
        _is_latched(bench, lease, fault, value)


@check("truth", of_faults=_counted)
def budget_for_transient_faults_ends(bench: Bench, fault: str) -> None:
    """A transient fault that does not end leads to FAULTED with its cause, or to no sample at all."""
    bench.changed = True
    lease = _begin(bench)
    bench.begin(fault, _BEYOND_ANY_BUDGET)
    bench.reach_faulted(_NOTICED_S, lease)
    assert isinstance(bench.device.fault, DeviceError)
    assert bench.device.fault.device == bench.device.name


@check("truth", "process")
def vanished_device_is_a_fault_and_can_return(bench: Bench) -> None:
    """kill -9 of the device: FAULTED, ``disconnect`` does not raise, and after its restart everything works again."""
    bench.spoiled = True
    lease = _begin(bench)
    bench.seat.vanish()
    bench.reach_faulted(_NOTICED_S, lease)
    bench.device.disconnect()
    assert bench.device.state is Lifecycle.DISCONNECTED
    with pytest.raises(DeviceError):
        bench.device.connect()
    assert bench.device.state is Lifecycle.DISCONNECTED
    assert bench.emulator
    bench.reconnect()


def _begin(bench: Bench) -> Lease | None:
    """Bring the device to ACTIVE and use it."""
    bench.active()
    if TwistSink not in bench.rig.spec.capabilities.provides:
        bench.until(lambda: _reads(bench), 2.0, "first sample")
        return None
    lease = bench.arm.acquire(OWNER)
    bench.stream(lease, bench.twist(bench.axis(), speed=_SLOW_M_S), _CALM_S)
    return lease


def _use(bench: Bench, lease: Lease | None, seconds: float) -> list[Any]:
    """Use the device as a task does; return the samples that it gave."""
    samples = []
    end_ns = bench.clock.now_ns() + round(seconds * 1e9)
    while bench.clock.now_ns() < end_ns:
        if lease is not None:
            with suppress(StaleData):
                bench.arm.send_twist(bench.command(bench.twist(bench.axis(), speed=_SLOW_M_S)), lease)
        with suppress(DeviceError):
            samples.append(bench.read())
        bench.sleep(0.01)
    return samples


def _is_survived(bench: Bench, lease: Lease | None, fault: str, value: Any, *, counted: bool) -> None:
    before = bench.counters()
    _use(bench, lease, _CALM_S)
    calm = bench.counters()
    bench.begin(fault, value)
    samples = _use(bench, lease, 2 * _CALM_S)
    assert bench.device.state is Lifecycle.ACTIVE, bench.device.fault
    after = bench.counters()
    assert len({sample.seq for sample in samples}) > 2
    stamps = [sample.t_ns for sample in samples]
    assert stamps == sorted(stamps)
    if not counted:
        return
    # Counters of normal operation grow most; on a busy machine those of faults are not constant either.
    grown = {name: calm[name] - before.get(name, 0) for name in calm}
    rare = {name for name in after if grown.get(name, 0) <= max(grown.values()) // 2}
    assert any(after[name] > calm.get(name, 0) for name in rare), f"counted nowhere in health: {after}"


def _is_called_stale(bench: Bench, fault: str, value: Any) -> None:
    bench.begin(fault, value)
    limit_s = 2.0 / (bench.rig.state_rate_hz or bench.rig.spec.capabilities.state_rate_hz)
    bench.until(lambda: _is_stale(bench, limit_s), _NOTICED_S, "StaleData")
    assert bench.device.state is not Lifecycle.FAULTED
    bench.end(fault)
    bench.until(lambda: not _is_stale(bench, 10.0 * limit_s), _NOTICED_S, "fresh samples")


def _is_stale(bench: Bench, limit_s: float) -> bool:
    try:
        bench.read(limit_s)
    except StaleData:
        return True
    return False


def _is_latched(bench: Bench, lease: Lease | None, fault: str, value: Any) -> None:
    bench.begin(fault, value)
    bench.reach_faulted(_NOTICED_S, lease)
    first = bench.device.fault
    assert isinstance(first, DeviceError)
    assert first.device == bench.device.name
    with pytest.raises(LifecycleError):
        bench.device.activate()
    if lease is not None:
        with pytest.raises(CommandRejected):
            bench.arm.send_twist(bench.command(bench.twist(bench.axis(), speed=_SLOW_M_S)), lease)
        if not bench.rig.spec.capabilities.falls_on_power_loss:
            bench.settle(3.0)
    bench.sleep(0.1)
    assert bench.device.state is Lifecycle.FAULTED
    assert bench.device.fault is first, "the first fault is the one to report"
    if fault in _LASTING:
        with pytest.raises(DeviceError):
            bench.device.recover(bench.token)
        assert bench.device.state is Lifecycle.FAULTED
    bench.end(fault)
    _serves_again(bench)
    if lease is not None:
        with pytest.raises(CommandRejected):
            bench.arm.send_twist(bench.command(bench.twist(bench.axis(), speed=_SLOW_M_S)), lease)


def _serves_again(bench: Bench) -> None:
    """``recover`` leads to READY, never to ACTIVE; if it cannot, reconnecting does."""
    deadline_ns = bench.clock.now_ns() + round(_RECOVERED_S * 1e9)
    while bench.is_in(Lifecycle.FAULTED) and bench.clock.now_ns() < deadline_ns:
        with suppress(DeviceError):
            bench.device.recover(bench.token)
            assert bench.is_in(Lifecycle.READY)
            assert bench.device.fault is None
        bench.sleep(0.05)
    if bench.is_in(Lifecycle.READY):
        with suppress(DeviceError):
            bench.device.activate()
    if not bench.is_in(Lifecycle.ACTIVE):
        if bench.rig.spec.capabilities.falls_on_power_loss:
            # It fell; it has to be lifted.
            bench.device.disconnect()
            bench.restore()
        bench.reconnect(_RECONNECTED_S)


def _reads(bench: Bench) -> bool:
    with suppress(DeviceError):
        bench.read()
        return True
    return False
