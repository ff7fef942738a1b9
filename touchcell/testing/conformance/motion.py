"""Checks of the true tool motion: it follows commands, and it stops in every failure of the client."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.commands import TwistFrame
from touchcell.drivers.core.protocols import TwistSink
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.client import MovingClient
from touchcell.testing.conformance.context import ConformanceContext

_STREAM_S = 0.8
_STEADY_S = 0.3
_HOST_DELAY_S = 0.06
"""Delay of a busy host in addition to the declared latency."""
_TTL_S = 0.2
_ATTEMPTS = 3
_LATE_S = 0.01
_AXES = ("vx", "vy", "vz", "wx", "wy", "wz")


@check(TwistSink, on_hardware=True)
def twists_along_base_axes_are_followed(context: ConformanceContext) -> None:
    """Along every declared axis the tool moves with the right sign, within 20 % of the speed."""
    _follows_all_axes(context, TwistFrame.BASE)


@check(TwistSink, on_hardware=True)
def twists_along_tool_axes_are_followed(context: ConformanceContext) -> None:
    """The same for twists along the tool's own axes."""
    _follows_all_axes(context, TwistFrame.TCP)


def _follows_all_axes(context: ConformanceContext, frame: TwistFrame) -> None:
    lease = context.leased()
    context.settle()
    wrong = []
    # Forward along base axes and back along the tool's, so that the two checks need little space.
    sign = 1.0 if frame is TwistFrame.BASE else -1.0
    for axis, follows in enumerate(context.rig.spec.capabilities.twist_axes):
        if not follows:
            continue
        asked = sign * context.twist(axis)
        for _ in range(_ATTEMPTS):
            track, sent = context.stream(lease, asked, _STREAM_S, frame=frame)
            context.arm.stop()
            context.settle()
            got = track.since(track.t_ns[-1] - _STEADY_S * 1e9).mean_twist(frame)
            size = abs(asked[axis])
            aside = np.delete(got[:3] if axis < 3 else got[3:], axis % 3)
            followed = abs(got[axis] - asked[axis]) <= 0.2 * size and np.abs(aside).max() <= 0.2 * size
            good = followed and not sent.adjustments
            # A measurement while the host overslept is no evidence about the driver.
            if good or context.late_s < _LATE_S:
                break
        if not good:
            wrong.append(f"{_AXES[axis]} {asked[axis]:+.3f}: {np.round(got, 4).tolist()} {sent.adjustments}")
    assert not wrong, "the tool moved otherwise:\n" + "\n".join(wrong)


@check(TwistSink, "limited axes")
def infeasible_axes_are_reported(context: ConformanceContext) -> None:
    """A twist along an undeclared axis is sent without it and reported as adjusted."""
    lease = context.leased()
    for axis, follows in enumerate(context.rig.spec.capabilities.twist_axes):
        if not follows:
            sent = context.arm.send_twist(context.command(context.twist(axis)), lease)
            assert sent.adjustments, f"axis {axis}"
    context.settle()


@check(TwistSink, on_hardware=True)
def time_to_live_stops_the_motion(context: ConformanceContext) -> None:
    """After the last command has expired the tool brakes, within the distance from latency and limits."""
    lease = context.leased()
    context.settle()
    asked = context.twist(context.axis())
    for _ in range(_ATTEMPTS):
        track, _sent = context.stream(lease, asked, _STREAM_S, ttl_s=_TTL_S)
        if context.late_s < _LATE_S:
            break
    expires_ns = track.t_ns[-1] + _TTL_S * 1e9
    steady = track.since(track.t_ns[-1] - _STEADY_S * 1e9).mean_twist(TwistFrame.BASE)
    assert np.linalg.norm(steady[:3]) > 0.5 * context.speed()
    rest = context.track_to_rest(_TTL_S + 2.0)
    travelled_m = np.linalg.norm(rest.poses[-1][:3, 3] - rest.position_at(expires_ns))
    assert travelled_m <= _braking_m(context, rest.late_s)


@check(TwistSink, on_hardware=True)
def stop_stops_at_once(context: ConformanceContext) -> None:
    """``stop`` needs no lease and does not wait for the time-to-live."""
    lease = context.leased()
    context.settle()
    context.stream(lease, context.twist(context.axis()), _STREAM_S, ttl_s=0.9)
    start = context.position()
    context.arm.stop()
    rest = context.track_to_rest(2.0)
    assert np.linalg.norm(rest.poses[-1][:3, 3] - start) <= _braking_m(context, rest.late_s)
    context.until(context.arm.at_rest, 1.0, "at_rest")


@check(TwistSink, on_hardware=True)
def release_stops_at_once(context: ConformanceContext) -> None:
    """Releasing the lease stops the arm too."""
    lease = context.leased()
    context.settle()
    context.stream(lease, context.twist(context.axis()), _STREAM_S, ttl_s=0.9)
    start = context.position()
    context.arm.release(lease)
    rest = context.track_to_rest(2.0)
    assert np.linalg.norm(rest.poses[-1][:3, 3] - start) <= _braking_m(context, rest.late_s)


@check(TwistSink, "truth", "process", "reachable")
def killed_client_leaves_the_arm_at_rest(context: ConformanceContext) -> None:
    """kill -9 of the client process: the device itself stops within its watchdog.

    An arm without brakes is tracked until its motors disable themselves, as it falls then by declaration.
    """
    context.spoiled = True
    falls = context.rig.spec.capabilities.falls_on_power_loss
    with MovingClient(
        context.under_test.function, context.under_test.folder, context.under_test.address, context.speed()
    ) as client:
        context.sleep(0.3)
        client.kill()
        start = context.position()
        start_ns = context.clock.now_ns()
        silence_s = client.silence_s
        rest = context.track_to_rest(silence_s + 3.0, (lambda truth: not truth["energised"]) if falls else None)
    assert (rest.t_ns[-1] - start_ns) * 1e-9 <= silence_s + 0.5 + rest.late_s
    assert np.linalg.norm(rest.poses[-1][:3, 3] - start) <= _braking_m(context, silence_s + rest.late_s)


def _braking_m(context: ConformanceContext, silence_s: float) -> float:
    """Return the longest allowed distance from the moment when the arm should begin to react, at test speed.

    ``silence_s`` is additional time: reaction of the client, and delay of this machine.
    """
    capabilities = context.rig.spec.capabilities
    speed = context.speed()
    delay_s = capabilities.command_latency_s + 1.0 / capabilities.state_rate_hz + _HOST_DELAY_S + silence_s
    return float(speed * delay_s + speed**2 / (2.0 * context.arm.limits.accel_m_s2))
