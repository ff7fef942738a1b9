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
from touchcell.testing.conformance.context import OWNER, ConformanceContext

_FORBIDDEN_TRAVEL_M = 1e-3
"""Much less than the motion caused by any accepted command; a compliant arm may still creep to its setpoint."""


def _refused(context: ConformanceContext, lease: Lease, reason: Rejection, **changes: Any) -> None:
    command = replace(context.command(context.twist(context.axis())), **changes)
    with pytest.raises(CommandRejected) as caught:
        context.arm.send_twist(command, lease)
    assert caught.value.reason is reason


@check(TwistSink, on_hardware=True)
def non_finite_commands_are_refused(context: ConformanceContext) -> None:
    """NaN and both infinities in any component, and in the time-to-live, are rejected and move nothing."""
    lease = context.leased()
    context.settle()
    start = context.position()
    for bad in (np.nan, np.inf, -np.inf):
        for component in range(6):
            twist = context.twist(context.axis())
            twist[component] = bad
            _refused(context, lease, Rejection.NON_FINITE, twist=twist)
        _refused(context, lease, Rejection.NON_FINITE, ttl_s=bad)
    context.sleep(0.1)
    assert np.linalg.norm(context.position() - start) < _FORBIDDEN_TRAVEL_M


@check(TwistSink, on_hardware=True)
def malformed_commands_are_refused(context: ConformanceContext) -> None:
    """Wrong shapes and unknown frames are rejected and move nothing."""
    lease = context.leased()
    context.settle()
    start = context.position()
    for twist in (np.zeros(5), np.zeros(7), np.zeros((6, 1)), np.array(0.0)):
        _refused(context, lease, Rejection.SHAPE, twist=twist)
    for frame in ("base", None, "tool"):
        _refused(context, lease, Rejection.FRAME, frame=frame)
    context.sleep(0.1)
    assert np.linalg.norm(context.position() - start) < _FORBIDDEN_TRAVEL_M


@check(TwistSink, on_hardware=True)
def commands_without_the_lease_are_refused(context: ConformanceContext) -> None:
    """A copied lease, another arm's, a released one: none of them moves the arm."""
    lease = context.leased()
    context.settle()
    start = context.position()
    _refused(context, replace(lease), Rejection.LEASE)
    _refused(context, Lease("another arm", OWNER, lease.epoch), Rejection.LEASE)
    context.arm.release(lease)
    _refused(context, lease, Rejection.LEASE)
    context.sleep(0.1)
    assert np.linalg.norm(context.position() - start) < _FORBIDDEN_TRAVEL_M


@check(TwistSink, on_hardware=True)
def second_owner_is_refused(context: ConformanceContext) -> None:
    """One owner at a time, by name; the next may acquire the lease after its release."""
    lease = context.leased()
    with pytest.raises(CommandRejected) as caught:
        context.arm.acquire("another")
    assert caught.value.reason is Rejection.LEASE
    assert context.arm.owner == OWNER
    context.arm.release(lease)
    assert context.arm.acquire("another").owner == "another"


@check(TwistSink, on_hardware=True)
def commands_out_of_their_time_are_refused(context: ConformanceContext) -> None:
    """Commands that are expired, from the future, or with a zero, negative or infinite time-to-live are rejected."""
    lease = context.leased()
    with pytest.raises(CommandRejected) as caught:
        context.arm.send_twist(context.command(context.twist(context.axis()), ttl_s=0.1, age_s=0.2), lease)
    assert caught.value.reason is Rejection.EXPIRED
    with pytest.raises(CommandRejected) as caught:
        context.arm.send_twist(context.command(context.twist(context.axis()), age_s=-5.0), lease)
    assert caught.value.reason is Rejection.EXPIRED
    for ttl_s in (0.0, -0.1, 1e6):
        _refused(context, lease, Rejection.LIMIT, ttl_s=ttl_s)


@check(TwistSink, on_hardware=True)
def commands_in_the_wrong_mode_are_refused(context: ConformanceContext) -> None:
    """Nothing moves an arm that is not ACTIVE, lease or not."""
    context.ready()
    lease = context.arm.acquire(OWNER)
    _refused(context, lease, Rejection.MODE)


@check(TwistSink)
def commands_over_the_limits_are_scaled_and_reported(context: ConformanceContext) -> None:
    """A tenfold speed is sent within the limit, along the same direction, and reported as adjusted; the arm is no
    faster either."""
    lease = context.leased()
    limit = context.arm.limits.speed_m_s
    track, sent = context.stream(lease, context.twist(context.axis(), speed=10.0 * limit), 0.5)
    assert any("speed" in adjustment.limit for adjustment in sent.adjustments)
    assert sent.limited
    linear = sent.command.twist[:3]
    assert np.linalg.norm(linear) <= limit * (1.0 + 1e-9)
    assert abs(linear[context.axis()]) == pytest.approx(np.linalg.norm(linear))
    context.arm.stop()
    steady = track.since(track.t_ns[-1] - 0.15e9)
    assert np.linalg.norm(steady.mean_twist(TwistFrame.BASE)[:3]) <= 1.1 * limit
    context.settle()


@check(TwistSink)
def acceleration_is_limited_and_reported(context: ConformanceContext) -> None:
    """From rest the first fast command is reduced by the acceleration limit."""
    lease = context.leased()
    limits = context.arm.limits
    ttl_s = min(0.02, 0.5 * limits.speed_m_s / limits.accel_m_s2)
    sent = context.arm.send_twist(
        context.command(context.twist(context.axis(), speed=limits.speed_m_s), ttl_s=ttl_s), lease
    )
    assert any("acceleration" in adjustment.limit for adjustment in sent.adjustments)
    assert np.linalg.norm(sent.command.twist[:3]) <= limits.accel_m_s2 * ttl_s * (1.0 + 1e-9)
    context.settle()
