"""Checks of cameras beyond timestamps and numbers: waiting, losing frames, and decoding on demand."""

from __future__ import annotations

from typing import Any

import pytest

from touchcell.drivers.core.errors import DeviceError, TransportTimeout
from touchcell.drivers.core.protocols import FrameSource
from touchcell.testing.conformance.check import check
from touchcell.testing.conformance.context import ConformanceContext

_UNREAD_PERIODS = 8


@check(FrameSource, on_hardware=True)
def next_waits_and_times_out(context: ConformanceContext) -> None:
    """``next`` returns a frame beyond the known number, and raises TransportTimeout if none arrives in time."""
    context.active()
    first = context.camera.next(-1, 2.0)
    assert context.camera.next(first.seq, 2.0).seq > first.seq
    ahead = round(context.rig.state_rate_hz or context.rig.spec.capabilities.state_rate_hz)
    start_ns = context.clock.now_ns()
    with pytest.raises(TransportTimeout) as caught:
        context.camera.next(first.seq + ahead, 0.1)
    assert caught.value.timeout_s == pytest.approx(0.1)
    assert (context.clock.now_ns() - start_ns) * 1e-9 >= 0.099


@check(FrameSource, on_hardware=True)
def latest_never_goes_back(context: ConformanceContext) -> None:
    """``latest`` repeats the newest frame until a newer one arrives, and skips unread ones."""
    rate_hz = context.rig.state_rate_hz or context.rig.spec.capabilities.state_rate_hz
    context.active()
    first = context.camera.next(-1, 2.0)
    context.sleep(_UNREAD_PERIODS / rate_hz)
    newest = context.camera.latest()
    assert newest.seq >= first.seq + _UNREAD_PERIODS // 2
    assert context.camera.latest().seq >= newest.seq


@check(FrameSource)
def unread_frames_are_not_decoded(context: ConformanceContext) -> None:
    """While frames pass unread OpenCV decodes none of them; a read decodes one."""
    import cv2

    decoded = 0
    original = cv2.imdecode

    def counting(*arguments: Any) -> Any:
        nonlocal decoded
        decoded += 1
        return original(*arguments)

    rate_hz = context.rig.state_rate_hz or context.rig.spec.capabilities.state_rate_hz
    context.active()
    first = context.camera.next(-1, 2.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cv2, "imdecode", counting)
        context.sleep(_UNREAD_PERIODS / rate_hz)
        assert decoded == 0
        assert context.camera.latest().seq > first.seq
        context.camera.latest()
    if decoded == 0:
        pytest.skip("does not decode with OpenCV: not observable")
    assert decoded <= 2


@check(FrameSource, "truth")
def lost_frames_leave_a_gap(context: ConformanceContext) -> None:
    """Frames lost in transport leave gaps in the sequence numbers."""
    if "drop" not in context.rig.faults:
        pytest.skip("its emulator drops no frames")
    context.active()
    seq = context.camera.next(-1, 2.0).seq
    context.begin("drop", 3)
    widest = 0
    for _ in range(12):
        try:
            frame = context.camera.next(seq, 1.0)
        except DeviceError:
            continue
        widest = max(widest, frame.seq - seq)
        seq = frame.seq
    assert widest >= 3
