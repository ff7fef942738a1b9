"""Checks of the true tool motion: it follows commands, and it stops in every failure of the client."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.commands import TwistFrame
from touchcell.drivers.core.protocols import TwistSink
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.client import MovingClient
from touchcell.testing.conformance.context import Bench

_STREAM_S = 0.8
_STEADY_S = 0.3
_HOST_DELAY_S = 0.06
"""Delay of a busy host in addition to the declared latency."""
_TTL_S = 0.2
_ATTEMPTS = 3
_LATE_S = 0.01
_AXES = ("vx", "vy", "vz", "wx", "wy", "wz")


@check(TwistSink, on_bench=True)
def twists_along_base_axes_are_followed(bench: Bench) -> None:
    """Along every declared axis the tool moves with the right sign, within 20 % of the speed."""
    _follows_all_axes(bench, TwistFrame.BASE)


@check(TwistSink, on_bench=True)
def twists_along_tool_axes_are_followed(bench: Bench) -> None:
    """The same for twists along the tool's own axes."""
    _follows_all_axes(bench, TwistFrame.TCP)


def _follows_all_axes(bench: Bench, frame: TwistFrame) -> None:
    lease = bench.leased()
    bench.settle()
    wrong = []
    # Forward along base axes and back along the tool's, so that the two checks need little space.
    sign = 1.0 if frame is TwistFrame.BASE else -1.0
    for axis, follows in enumerate(bench.rig.spec.capabilities.twist_axes):
        if not follows:
            continue
        asked = sign * bench.twist(axis)
        for _ in range(_ATTEMPTS):
            track, sent = bench.stream(lease, asked, _STREAM_S, frame=frame)
            bench.arm.stop()
            bench.settle()
            got = track.since(track.t_ns[-1] - _STEADY_S * 1e9).mean_twist(frame)
            size = abs(asked[axis])
            aside = np.delete(got[:3] if axis < 3 else got[3:], axis % 3)
            followed = abs(got[axis] - asked[axis]) <= 0.2 * size and np.abs(aside).max() <= 0.2 * size
            good = followed and not sent.adjustments
            # A measurement while the host overslept is no evidence about the driver.
            if good or bench.late_s < _LATE_S:
                break
        if not good:
            wrong.append(f"{_AXES[axis]} {asked[axis]:+.3f}: {np.round(got, 4).tolist()} {sent.adjustments}")
    assert not wrong, "the tool moved otherwise:\n" + "\n".join(wrong)


@check(TwistSink, "limited axes")
def axes_that_it_cannot_follow_are_reported(bench: Bench) -> None:
    """A twist along an undeclared axis is sent without it and reported as adjusted."""
    lease = bench.leased()
    for axis, follows in enumerate(bench.rig.spec.capabilities.twist_axes):
        if not follows:
            sent = bench.arm.send_twist(bench.command(bench.twist(axis)), lease)
            assert sent.adjustments, f"axis {axis}"
    bench.settle()


@check(TwistSink, on_bench=True)
def time_to_live_stops_the_motion(bench: Bench) -> None:
    """After the last command has expired the tool brakes, within the distance from latency and limits."""
    lease = bench.leased()
    bench.settle()
    asked = bench.twist(bench.axis())
    for _ in range(_ATTEMPTS):
        track, _sent = bench.stream(lease, asked, _STREAM_S, ttl_s=_TTL_S)
        if bench.late_s < _LATE_S:
            break
    expires_ns = track.t_ns[-1] + _TTL_S * 1e9
    steady = track.since(track.t_ns[-1] - _STEADY_S * 1e9).mean_twist(TwistFrame.BASE)
    assert np.linalg.norm(steady[:3]) > 0.5 * bench.speed()
    rest = bench.track_to_rest(_TTL_S + 2.0)
    travelled_m = np.linalg.norm(rest.poses[-1][:3, 3] - rest.position_at(expires_ns))
    assert travelled_m <= _braking_m(bench, rest.late_s)


@check(TwistSink, on_bench=True)
def stop_stops_at_once(bench: Bench) -> None:
    """``stop`` needs no lease and does not wait for the time-to-live."""
    lease = bench.leased()
    bench.settle()
    bench.stream(lease, bench.twist(bench.axis()), _STREAM_S, ttl_s=0.9)
    start = bench.position()
    bench.arm.stop()
    rest = bench.track_to_rest(2.0)
    assert np.linalg.norm(rest.poses[-1][:3, 3] - start) <= _braking_m(bench, rest.late_s)
    bench.until(bench.arm.at_rest, 1.0, "at_rest")


@check(TwistSink, on_bench=True)
def release_stops_at_once(bench: Bench) -> None:
    """Releasing the lease stops the arm too."""
    lease = bench.leased()
    bench.settle()
    bench.stream(lease, bench.twist(bench.axis()), _STREAM_S, ttl_s=0.9)
    start = bench.position()
    bench.arm.release(lease)
    rest = bench.track_to_rest(2.0)
    assert np.linalg.norm(rest.poses[-1][:3, 3] - start) <= _braking_m(bench, rest.late_s)


@check(TwistSink, "truth", "process")
def killed_client_leaves_the_arm_at_rest(bench: Bench) -> None:
    """kill -9 of the client process: the device itself stops within its watchdog.

    An arm without brakes is tracked until its motors disable themselves, as it falls then by declaration.
    """
    bench.spoiled = True
    falls = bench.rig.spec.capabilities.falls_on_power_loss
    with MovingClient(bench.seat.function, bench.seat.folder, bench.seat.address, bench.speed()) as client:
        bench.sleep(0.3)
        client.kill()
        start = bench.position()
        start_ns = bench.clock.now_ns()
        silence_s = client.silence_s
        rest = bench.track_to_rest(silence_s + 3.0, (lambda truth: not truth["energised"]) if falls else None)
    assert (rest.t_ns[-1] - start_ns) * 1e-9 <= silence_s + 0.5 + rest.late_s
    assert np.linalg.norm(rest.poses[-1][:3, 3] - start) <= _braking_m(bench, silence_s + rest.late_s)


def _braking_m(bench: Bench, silence_s: float) -> float:
    """Return the longest allowed distance from the moment when the arm should begin to react, at test speed.

    ``silence_s`` is additional time: reaction of the client, and delay of this machine.
    """
    capabilities = bench.rig.spec.capabilities
    speed = bench.speed()
    delay_s = capabilities.command_latency_s + 1.0 / capabilities.state_rate_hz + _HOST_DELAY_S + silence_s
    return float(speed * delay_s + speed**2 / (2.0 * bench.arm.limits.accel_m_s2))
