"""Checks of delivered samples: timestamped, numbered, finite, and never stale data as new."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from touchcell.drivers.core.errors import DeviceError, StaleData
from touchcell.drivers.core.protocols import JointSource, TcpSource, WrenchSource
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.context import Bench

_WINDOW_S = 0.5
_FROZEN_S = 0.3


@check(TcpSource, on_bench=True)
def states_are_stamped_and_numbered(bench: Bench) -> None:
    """Timestamps are on the injected clock and advance; numbers rise; values are finite rigid poses."""
    before_ns = bench.clock.now_ns()
    bench.ready()
    samples = []
    end_ns = bench.clock.now_ns() + round(_WINDOW_S * 1e9)
    while bench.clock.now_ns() < end_ns:
        samples.append(bench.arm.tcp())
        assert samples[-1].t_ns <= bench.clock.now_ns()
        bench.sleep(0.002)
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
    _agrees_with_rate(bench, samples)


@check("camera", on_bench=True)
def frames_are_stamped_and_numbered(bench: Bench) -> None:
    """Timestamps are on the injected clock and rise with the numbers, by about a period each."""
    before_ns = bench.clock.now_ns()
    bench.active()
    frames = [bench.camera.next(-1, 2.0)]
    end_ns = bench.clock.now_ns() + round(_WINDOW_S * 1e9)
    while bench.clock.now_ns() < end_ns:
        frames.append(bench.camera.next(frames[-1].seq, 1.0))
        assert frames[-1].t_ns <= bench.clock.now_ns()
    assert frames[0].t_ns >= before_ns - round(0.1e9)
    for older, newer in pairwise(frames):
        assert newer.seq > older.seq
        assert newer.t_ns > older.t_ns
        assert newer.value.image.dtype == np.uint8
        assert newer.value.image.shape == older.value.image.shape
    _agrees_with_rate(bench, frames)


def _agrees_with_rate(bench: Bench, samples: list[Any]) -> None:
    """Check that numbers rise at no less than half the declared rate, as machines are busy; samples arrive at no more
    than 2.5 times it, as some drivers read more often at rest.
    """
    declared_hz = bench.rig.state_rate_hz or bench.rig.spec.capabilities.state_rate_hz
    first, last = samples[0], samples[-1]
    passed_s = (last.t_ns - first.t_ns) * 1e-9
    assert last.seq - first.seq >= 0.5 * declared_hz * passed_s
    assert len({sample.seq for sample in samples}) - 1 <= 2.5 * declared_hz * passed_s


@check(on_bench=True)
def too_old_is_stale(bench: Bench) -> None:
    """A sample older than the caller accepts is rejected with its age, limit and number."""
    bench.active()
    bench.until(lambda: _newest_is_there(bench), 2.0, "first sample")
    with pytest.raises(StaleData) as caught:
        bench.read(max_age_s=-1.0)
    assert caught.value.limit_s == -1.0
    assert caught.value.age_s > -1.0


@check(JointSource, on_bench=True)
def joints_are_finite_and_fresh(bench: Bench) -> None:
    """Joint angles and velocities have one length, are finite, and no older than requested."""
    device = bench.ready()
    assert isinstance(device, JointSource)
    sample = device.joints(max_age_s=0.5)
    assert sample.value.q.shape == sample.value.dq.shape
    assert np.isfinite(sample.value.q).all()
    assert np.isfinite(sample.value.dq).all()


@check(WrenchSource, on_bench=True)
def wrench_is_finite_and_fresh(bench: Bench) -> None:
    """The wrench is (6,) finite numbers, no older than requested."""
    device = bench.ready()
    assert isinstance(device, WrenchSource)
    wrench = device.wrench(max_age_s=0.5).value
    assert wrench.shape == (6,)
    assert np.isfinite(wrench).all()


@check("truth", "process")
def frozen_device_never_looks_fresh(bench: Bench) -> None:
    """While the device hangs, no earlier sample is returned with a younger timestamp, nor within a short max_age."""
    bench.spoiled = True
    bench.active()
    bench.until(lambda: _newest_is_there(bench), 2.0, "first sample")
    bench.emulator.freeze()
    frozen_ns = bench.clock.now_ns()
    bench.sleep(_FROZEN_S)
    with pytest.raises(DeviceError):
        bench.read(max_age_s=_FROZEN_S / 2)
    # Raising every time is correct too.
    with suppress(DeviceError):
        assert bench.read().t_ns <= frozen_ns + round(0.05e9)


def _newest_is_there(bench: Bench) -> bool:
    try:
        bench.read()
    except StaleData:
        return False
    return True
