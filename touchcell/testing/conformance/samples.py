"""Checks of delivered samples: timestamped, numbered, finite, and never stale data as new."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from touchcell.drivers.core.errors import DeviceError, StaleData
from touchcell.drivers.core.protocols import JointSource, ReadingSource, TcpSource, WrenchSource
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.context import ConformanceContext

_WINDOW_S = 0.5
_FROZEN_S = 0.3


@check(TcpSource, on_hardware=True)
def states_are_stamped_and_numbered(context: ConformanceContext) -> None:
    """Timestamps are on the injected clock and advance; numbers rise; values are finite rigid poses."""
    before_ns = context.clock.now_ns()
    context.ready()
    samples = []
    end_ns = context.clock.now_ns() + round(_WINDOW_S * 1e9)
    while context.clock.now_ns() < end_ns:
        samples.append(context.arm.tcp())
        assert samples[-1].t_ns <= context.clock.now_ns()
        context.sleep(0.002)
    # A sample in progress before the connection may be a little older than it.
    assert samples[0].t_ns > before_ns - round(0.1e9)
    for older, newer in pairwise(samples):
        assert newer.t_ns >= older.t_ns
        assert newer.seq >= older.seq
        assert (newer.seq > older.seq) == (newer.t_ns > older.t_ns)
    for sample in samples:
        T = sample.value.T_base_tcp
        assert T.shape == (4, 4)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
        assert sample.value.twist.shape == (6,)
        assert np.isfinite(T).all()
        assert np.isfinite(sample.value.twist).all()
    _agrees_with_rate(context, samples)


@check("camera", on_hardware=True)
def frames_are_stamped_and_numbered(context: ConformanceContext) -> None:
    """Timestamps are on the injected clock and rise with the numbers, by about a period each."""
    before_ns = context.clock.now_ns()
    context.active()
    frames = [context.camera.next(-1, 2.0)]
    end_ns = context.clock.now_ns() + round(_WINDOW_S * 1e9)
    while context.clock.now_ns() < end_ns:
        frames.append(context.camera.next(frames[-1].seq, 1.0))
        assert frames[-1].t_ns <= context.clock.now_ns()
    assert frames[0].t_ns >= before_ns - round(0.1e9)
    for older, newer in pairwise(frames):
        assert newer.seq > older.seq
        assert newer.t_ns > older.t_ns
        assert newer.value.image.dtype == np.uint8
        assert newer.value.image.shape == older.value.image.shape
    _agrees_with_rate(context, frames)


def _agrees_with_rate(context: ConformanceContext, samples: list[Any]) -> None:
    """Check that numbers rise at no less than half the declared rate, as machines are busy; samples arrive at no more
    than 2.5 times it, as some drivers read more often at rest.
    """
    declared_hz = context.rig.state_rate_hz or context.rig.spec.capabilities.state_rate_hz
    first, last = samples[0], samples[-1]
    passed_s = (last.t_ns - first.t_ns) * 1e-9
    assert last.seq - first.seq >= 0.5 * declared_hz * passed_s
    assert len({sample.seq for sample in samples}) - 1 <= 2.5 * declared_hz * passed_s


@check(on_hardware=True)
def old_samples_are_stale(context: ConformanceContext) -> None:
    """A sample older than the caller accepts is rejected with its age, limit and number."""
    context.active()
    context.until(lambda: _newest_is_there(context), 2.0, "first sample")
    with pytest.raises(StaleData) as caught:
        context.read(max_age_s=-1.0)
    assert caught.value.limit_s == -1.0
    assert caught.value.age_s > -1.0


@check(JointSource, on_hardware=True)
def joints_are_finite_and_fresh(context: ConformanceContext) -> None:
    """Joint angles and velocities have one length, are finite, and no older than requested."""
    device = context.ready()
    assert isinstance(device, JointSource)
    sample = device.joints(max_age_s=0.5)
    assert sample.value.q.shape == sample.value.dq.shape
    assert np.isfinite(sample.value.q).all()
    assert np.isfinite(sample.value.dq).all()


@check(WrenchSource, on_hardware=True)
def wrench_is_finite_and_fresh(context: ConformanceContext) -> None:
    """The wrench is (6,) finite numbers, no older than requested."""
    device = context.ready()
    assert isinstance(device, WrenchSource)
    wrench = device.wrench(max_age_s=0.5).value
    assert wrench.shape == (6,)
    assert np.isfinite(wrench).all()


@check(ReadingSource, on_hardware=True)
def readings_are_stamped_and_numbered(context: ConformanceContext) -> None:
    """Timestamps are on the injected clock and rise with the numbers; values are finite numbers of constant names."""
    before_ns = context.clock.now_ns()
    context.active()
    samples = []
    end_ns = context.clock.now_ns() + round(_WINDOW_S * 1e9)
    while context.clock.now_ns() < end_ns:
        samples.append(context.read())
        assert samples[-1].t_ns <= context.clock.now_ns()
        context.sleep(0.002)
    assert samples[0].t_ns > before_ns - round(0.1e9)
    for older, newer in pairwise(samples):
        assert (newer.seq > older.seq) == (newer.t_ns > older.t_ns)
        assert newer.seq >= older.seq
        assert newer.value.keys() == older.value.keys()
    for sample in samples:
        assert np.isfinite(list(sample.value.values())).all()
    _agrees_with_rate(context, samples)


@check("truth", "process")
def frozen_device_never_looks_fresh(context: ConformanceContext) -> None:
    """While the device hangs, no earlier sample is returned with a younger timestamp, nor within a short max_age."""
    context.spoiled = True
    context.active()
    context.until(lambda: _newest_is_there(context), 2.0, "first sample")
    context.emulator.freeze()
    frozen_ns = context.clock.now_ns()
    context.sleep(_FROZEN_S)
    with pytest.raises(DeviceError):
        context.read(max_age_s=_FROZEN_S / 2)
    # Raising every time is correct too.
    with suppress(DeviceError):
        assert context.read().t_ns <= frozen_ns + round(0.05e9)


def _newest_is_there(context: ConformanceContext) -> bool:
    try:
        context.read()
    except StaleData:
        return False
    return True
