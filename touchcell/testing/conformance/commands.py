"""Checks of the command gate: rejected commands, limited commands, reported adjustments."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from touchcell.drivers.core.commands import TwistFrame
from touchcell.drivers.core.errors import CommandRejected, Rejection
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import TwistSink
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.context import OWNER, Bench

_FORBIDDEN_TRAVEL_M = 1e-3
"""Much less than the motion caused by any accepted command; a compliant arm may still creep to its setpoint."""


def _refused(bench: Bench, lease: Lease, reason: Rejection, **changes: Any) -> None:
    command = replace(bench.command(bench.twist(bench.axis())), **changes)
    with pytest.raises(CommandRejected) as caught:
        bench.arm.send_twist(command, lease)
    assert caught.value.reason is reason


@check(TwistSink, on_bench=True)
def non_finite_commands_are_refused(bench: Bench) -> None:
    """NaN and both infinities in any component, and in the time-to-live, are rejected and move nothing."""
    lease = bench.leased()
    bench.settle()
    start = bench.position()
    for bad in (np.nan, np.inf, -np.inf):
        for component in range(6):
            twist = bench.twist(bench.axis())
            twist[component] = bad
            _refused(bench, lease, Rejection.NON_FINITE, twist=twist)
        _refused(bench, lease, Rejection.NON_FINITE, ttl_s=bad)
    bench.sleep(0.1)
    assert np.linalg.norm(bench.position() - start) < _FORBIDDEN_TRAVEL_M


@check(TwistSink, on_bench=True)
def malformed_commands_are_refused(bench: Bench) -> None:
    """Wrong shapes and unknown frames are rejected and move nothing."""
    lease = bench.leased()
    bench.settle()
    start = bench.position()
    for twist in (np.zeros(5), np.zeros(7), np.zeros((6, 1)), np.array(0.0)):
        _refused(bench, lease, Rejection.SHAPE, twist=twist)
    for frame in ("base", None, "tool"):
        _refused(bench, lease, Rejection.FRAME, frame=frame)
    bench.sleep(0.1)
    assert np.linalg.norm(bench.position() - start) < _FORBIDDEN_TRAVEL_M


@check(TwistSink, on_bench=True)
def commands_without_the_lease_are_refused(bench: Bench) -> None:
    """A copied lease, another arm's, a released one: none of them moves the arm."""
    lease = bench.leased()
    bench.settle()
    start = bench.position()
    _refused(bench, replace(lease), Rejection.LEASE)
    _refused(bench, Lease("another arm", OWNER, lease.epoch), Rejection.LEASE)
    bench.arm.release(lease)
    _refused(bench, lease, Rejection.LEASE)
    bench.sleep(0.1)
    assert np.linalg.norm(bench.position() - start) < _FORBIDDEN_TRAVEL_M


@check(TwistSink, on_bench=True)
def second_owner_is_refused(bench: Bench) -> None:
    """One owner at a time, by name; the next may acquire the lease after its release."""
    lease = bench.leased()
    with pytest.raises(CommandRejected) as caught:
        bench.arm.acquire("another")
    assert caught.value.reason is Rejection.LEASE
    assert bench.arm.owner == OWNER
    bench.arm.release(lease)
    assert bench.arm.acquire("another").owner == "another"


@check(TwistSink, on_bench=True)
def commands_out_of_their_time_are_refused(bench: Bench) -> None:
    """Commands that are expired, from the future, or with a zero, negative or infinite time-to-live are rejected."""
    lease = bench.leased()
    with pytest.raises(CommandRejected) as caught:
        bench.arm.send_twist(bench.command(bench.twist(bench.axis()), ttl_s=0.1, age_s=0.2), lease)
    assert caught.value.reason is Rejection.EXPIRED
    with pytest.raises(CommandRejected) as caught:
        bench.arm.send_twist(bench.command(bench.twist(bench.axis()), age_s=-5.0), lease)
    assert caught.value.reason is Rejection.EXPIRED
    for ttl_s in (0.0, -0.1, 1e6):
        _refused(bench, lease, Rejection.LIMIT, ttl_s=ttl_s)


@check(TwistSink, on_bench=True)
def commands_in_the_wrong_mode_are_refused(bench: Bench) -> None:
    """Nothing moves an arm that is not ACTIVE, lease or not."""
    bench.ready()
    lease = bench.arm.acquire(OWNER)
    _refused(bench, lease, Rejection.MODE)


@check(TwistSink)
def commands_over_the_limits_are_scaled_and_reported(bench: Bench) -> None:
    """A tenfold speed is sent within the limit, along the same direction, and reported as adjusted; the arm is no
    faster either."""
    lease = bench.leased()
    limit = bench.arm.limits.speed_m_s
    track, sent = bench.stream(lease, bench.twist(bench.axis(), speed=10.0 * limit), 0.5)
    assert any("speed" in adjustment.limit for adjustment in sent.adjustments)
    assert sent.limited
    linear = sent.command.twist[:3]
    assert np.linalg.norm(linear) <= limit * (1.0 + 1e-9)
    assert abs(linear[bench.axis()]) == pytest.approx(np.linalg.norm(linear))
    bench.arm.stop()
    steady = track.since(track.t_ns[-1] - 0.15e9)
    assert np.linalg.norm(steady.mean_twist(TwistFrame.BASE)[:3]) <= 1.1 * limit
    bench.settle()


@check(TwistSink)
def acceleration_is_limited_and_reported(bench: Bench) -> None:
    """From rest the first fast command is reduced by the acceleration limit."""
    lease = bench.leased()
    limits = bench.arm.limits
    ttl_s = min(0.02, 0.5 * limits.speed_m_s / limits.accel_m_s2)
    sent = bench.arm.send_twist(bench.command(bench.twist(bench.axis(), speed=limits.speed_m_s), ttl_s=ttl_s), lease)
    assert any("acceleration" in adjustment.limit for adjustment in sent.adjustments)
    assert np.linalg.norm(sent.command.twist[:3]) <= limits.accel_m_s2 * ttl_s * (1.0 + 1e-9)
    bench.settle()
