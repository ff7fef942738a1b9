"""Fallback driver for cameras that only OpenCV can open: no sequence numbers, settings as far as OpenCV reports them.

Prefer the driver ``v4l2``: OpenCV hides the kernel's frame counter, corrupt-frame flag and error numbers.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

from touchcell.drivers.core.camera import Camera, CameraConfig, RawFrame, UnsupportedSetting, camera_behaviour
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import ConnectError, DeviceGone
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.samples import Quality
from touchcell.drivers.core.spec import Capabilities, DriverContext, DriverSpec
from touchcell.drivers.v4l2 import codec

if TYPE_CHECKING:
    import cv2

_QUEUE_FRAMES = 32
_PLAUSIBLE_AGE_NS = 2_000_000_000
_RATE_TOLERANCE = 0.01
# The kernel may report an error for one frame (EIO, signal lost) and deliver the next.
_FAILED_GRABS = 3


class OpencvCameraConfig(CameraConfig):
    """Settings of an OpenCV camera; see ``CameraConfig``."""


class _Reader(threading.Thread):
    """Drain OpenCV's queue continuously, since OpenCV has no call to test whether a frame is waiting."""

    def __init__(self, name: str, capture: cv2.VideoCapture, clock: Clock) -> None:
        super().__init__(name=f"{name} reader", daemon=True)
        self.arrived = threading.Condition()
        self.frames: deque[tuple[bytes, int, int]] = deque(maxlen=_QUEUE_FRAMES)
        self.ended = False
        self._capture = capture
        self._clock = clock
        self._stop_asked = threading.Event()

    def run(self) -> None:
        """Read until stopped or until the camera fails."""
        failed = 0
        while not self._stop_asked.is_set() and failed < _FAILED_GRABS:
            frame = self._grab()
            failed = 0 if frame is not None else failed + 1
            if frame is not None:
                with self.arrived:
                    self.frames.append(frame)
                    self.arrived.notify_all()
        with self.arrived:
            self.ended = True
            self.arrived.notify_all()

    def _grab(self) -> tuple[bytes, int, int] | None:
        """Return the next frame's bytes, stamp and time of arrival; None if OpenCV could not read one."""
        import cv2

        try:
            if not self._capture.grab():
                return None
            received_ns = self._clock.now_ns()
            stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            whole, data = self._capture.retrieve()
        except cv2.error:
            return None
        return data.tobytes() if whole else b"", stamp_ns, received_ns

    def finish(self) -> None:
        """Stop and join the thread: takes at most OpenCV's own timeout for a frame, 10 s."""
        self._stop_asked.set()
        self.join()


class OpencvCamera(Camera):
    """Driver for a camera with cv2.VideoCapture and its V4L2 backend.

    A thread reads continuously from ``configure`` to ``disconnect``; if it ends by itself, that is DeviceGone. Frames
    are numbered on arrival, and losses are estimated from gaps between timestamps.
    """

    def __init__(self, name: str, clock: Clock, config: OpencvCameraConfig) -> None:
        super().__init__(name, clock, config)
        self._capture: cv2.VideoCapture | None = None
        self._reader: _Reader | None = None
        self._previous_ns: int | None = None
        self._kernel_stamps = False
        self._exposure_us: int | None = None
        self._gain: int | None = None

    def _open(self) -> None:
        import cv2

        self._capture = cv2.VideoCapture(self._config.device, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise ConnectError(
                self.name,
                f"OpenCV cannot open {self._config.device}",
                hint="OpenCV reports no reason; the driver v4l2 would, and so does `touchcell devices`",
            )

    def _close(self) -> None:
        self._stop_reader()
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _configure(self) -> None:
        capture = self._capture
        assert capture is not None
        self._set_format(capture)
        self._set_controls(capture)
        self._previous_ns = None
        self._reader = _Reader(self.name, capture, self._clock)
        self._reader.start()
        try:
            self._begin_stream()
        except BaseException:
            self._stop_reader()
            raise

    def _stop_reader(self) -> None:
        if self._reader is not None:
            self._reader.finish()
            self._reader = None

    def _set_format(self, capture: cv2.VideoCapture) -> None:
        import cv2

        config = self._config
        # Undecoded bytes, so that corrupt frames are detected and frames are decoded only on demand.
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0)
        capture.set(cv2.CAP_PROP_FOURCC, float(codec.fourcc(config.pixel_format)))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.width_px)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height_px)
        capture.set(cv2.CAP_PROP_FPS, config.rate_hz)
        self._expect(
            "pixel_format", config.pixel_format, codec.fourcc_text(int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF)
        )
        self._expect("width_px", config.width_px, int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)))
        self._expect("height_px", config.height_px, int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
        if abs(rate_hz - config.rate_hz) > _RATE_TOLERANCE * config.rate_hz:
            raise UnsupportedSetting(self.name, "rate_hz", config.rate_hz, rate_hz)

    def _set_controls(self, capture: cv2.VideoCapture) -> None:
        import cv2

        config = self._config
        if capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) >= 0.0:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, codec.EXPOSURE_MANUAL)
            given = int(capture.get(cv2.CAP_PROP_AUTO_EXPOSURE))
            self._expect("automatic exposure", codec.EXPOSURE_MANUAL, given)
        if capture.get(cv2.CAP_PROP_AUTO_WB) > 0.0:
            capture.set(cv2.CAP_PROP_AUTO_WB, 0.0)
            self._expect("automatic white balance", 0, int(capture.get(cv2.CAP_PROP_AUTO_WB)))
        unit = codec.EXPOSURE_UNIT_US
        self._exposure_us = self._set_value(capture, cv2.CAP_PROP_EXPOSURE, "exposure_us", config.exposure_us, unit)
        if self._exposure_us is not None and self._exposure_us * config.rate_hz > 1e6:
            raise UnsupportedSetting(self.name, "exposure_us", f"at most {1e6 / config.rate_hz:.0f}", self._exposure_us)
        self._gain = self._set_value(capture, cv2.CAP_PROP_GAIN, "gain", config.gain, 1)

    def _set_value(
        self, capture: cv2.VideoCapture, identity: int, setting: str, value: int | None, unit: int
    ) -> int | None:
        if value is not None:
            capture.set(identity, value // unit)
        given = int(capture.get(identity))
        if value is not None:
            self._expect(setting, value, given * unit if given >= 0 else None)
        return given * unit if given >= 0 else None

    def _expect(self, setting: str, requested: object, given: object) -> None:
        if requested != given:
            raise UnsupportedSetting(self.name, setting, requested, given)

    def _collect(self) -> bool:
        reader = self._reader
        assert reader is not None
        with reader.arrived:
            waiting = list(reader.frames)
            reader.frames.clear()
            ended = reader.ended
        for position, (data, stamp_ns, received_ns) in enumerate(waiting):
            self._examine(data, stamp_ns, received_ns, overrun=position == 0 and len(waiting) == _QUEUE_FRAMES)
        if ended:
            raise DeviceGone(self.name, "OpenCV receives no frames", hint="OpenCV reports no reason; recover to reopen")
        # The reader's queue drops its oldest, so the newest is always the last one received.
        return False

    def _examine(self, data: bytes, stamp_ns: int, received_ns: int, *, overrun: bool) -> None:
        self._kernel_stamps = 0 <= received_ns - stamp_ns < _PLAUSIBLE_AGE_NS
        t_ns = stamp_ns if self._kernel_stamps else received_ns
        previous_ns, self._previous_ns = self._previous_ns, t_ns
        if previous_ns is not None and t_ns <= previous_ns:
            self._monitor.count_bad("out_of_order")
            return
        if previous_ns is not None:
            periods = round((t_ns - previous_ns) * 1e-9 * self._config.rate_hz)
            self._monitor.count_lost(max(0, periods - 1), overrun=overrun)
            if not overrun:
                self._rate.note((t_ns - previous_ns) * 1e-9, 1)
        if codec.damage(data, self._config.pixel_format, self._config.width_px, self._config.height_px):
            self._monitor.count_bad("damaged")
            return
        self._monitor.count_good(data)
        quality = Quality.GOOD if self._kernel_stamps else Quality.SUSPECT
        self._store(RawFrame(data, t_ns, self._last_seq + 1, None if self._kernel_stamps else stamp_ns, quality))

    def _wait(self, timeout_s: float) -> None:
        reader = self._reader
        assert reader is not None
        with reader.arrived:
            reader.arrived.wait_for(lambda: reader.frames or reader.ended, timeout_s)

    def _exposure_and_gain(self) -> tuple[float | None, float | None]:
        return (
            None if self._exposure_us is None else self._exposure_us * 1e-6,
            None if self._gain is None else float(self._gain),
        )

    def _settings(self) -> dict[str, float | int | str | bool]:
        readings: dict[str, float | int | str | bool] = {
            "sequence_numbers": False,
            "kernel_stamps": self._kernel_stamps,
        }
        if self._exposure_us is not None:
            readings["exposure_us"] = self._exposure_us
        if self._gain is not None:
            readings["gain"] = self._gain
        return readings


def build(name: str, config: OpencvCameraConfig, context: DriverContext) -> OpencvCamera:
    """Build a DISCONNECTED camera."""
    return OpencvCamera(name, context.clock, config)


SPEC = DriverSpec(
    name="opencv_camera",
    summary="camera through OpenCV, where v4l2 cannot be used; lost frames are guessed, faults have no cause",
    config=OpencvCameraConfig,
    capabilities=Capabilities(kind="camera", provides=frozenset({FrameSource, HealthSource}), state_rate_hz=30.0),
    build=build,
    behaviour=camera_behaviour,
)
