"""Common base of all live cameras: deliver the newest frame, or an error with the reason why there is none.

The frame queue is drained when the application reads; only the newest frame is kept, and it is decoded once, on demand.
No reader thread is needed where a queue can be drained without blocking and is deep enough for the longest pause
between two reads. After a longer pause the queue is full of old frames; this is detected and a new frame is awaited.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal, Self, final

import numpy as np
from pydantic import Field, model_validator

from touchcell.drivers.core.behaviour import CameraBehaviour
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import (
    CorruptMessage,
    DeviceError,
    DeviceFault,
    FaultClass,
    Remedy,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.frame_monitor import FrameMonitor
from touchcell.drivers.core.frame_rate import FrameRate
from touchcell.drivers.core.samples import Frame, Quality, Stamped
from touchcell.drivers.core.spec import DriverConfig
from touchcell.errors import ConfigError
from touchcell.geometry.types import ImageArray

_FIRST_FRAME_S = 5.0
_UNREAD_PERIODS = 4.0
_STALL_PERIODS = 3
_SHORTEST_WAIT_S = 1e-3


class CameraConfig(DriverConfig):
    """Settings of every live camera. Each one is read back; a camera that applies another value is refused.

    Attributes:
        device: node of the camera. Names under /dev/v4l/by-id or by-path stay with the camera; /dev/videoN may not.
        width_px, height_px: picture size.
        pixel_format: MJPG saves USB bandwidth; YUYV and GREY are not compressed.
        rate_hz: frames per second.
        color: what ``Frame.image`` holds, grey (height, width) or BGR (height, width, 3).
        exposure_us: exposure time in steps of 100 us, at most one frame, or None to keep the camera's own. Automatic
            exposure is switched off either way.
        gain: gain in the camera's own units, or None to keep its own.
        stall_s: silence after which the camera counts as failed; at least three periods.
    """

    device: str = Field(min_length=1)
    width_px: int = Field(default=640, gt=0, le=8192)
    height_px: int = Field(default=480, gt=0, le=8192)
    pixel_format: Literal["MJPG", "YUYV", "GREY"] = "MJPG"
    rate_hz: float = Field(default=30.0, gt=0.0, le=1000.0)
    color: Literal["grey", "bgr"] = "grey"
    exposure_us: int | None = Field(default=None, gt=0, multiple_of=100)
    gain: int | None = Field(default=None, ge=0)
    stall_s: float = Field(default=0.5, gt=0.0, le=10.0)

    @model_validator(mode="after")
    def _silence_is_longer_than_the_period(self) -> Self:
        if self.stall_s * self.rate_hz < _STALL_PERIODS:
            raise ValueError(f"stall_s must be at least {_STALL_PERIODS} periods, {_STALL_PERIODS / self.rate_hz:g} s")
        return self

    @model_validator(mode="after")
    def _exposure_fits_into_a_frame(self) -> Self:
        if self.exposure_us is not None and self.exposure_us * self.rate_hz > 1e6:
            raise ValueError(
                f"exposure_us {self.exposure_us} is longer than a frame at {self.rate_hz:g} Hz, "
                f"{1e6 / self.rate_hz:.0f} us: the camera would deliver fewer frames"
            )
        return self


def camera_behaviour(config: CameraConfig) -> CameraBehaviour:
    """Return how a USB camera behaves: a frame arrives about one period after its exposure."""
    return CameraBehaviour(
        config.rate_hz, 1.0 / config.rate_hz, config.width_px, config.height_px, color=config.color == "bgr"
    )


class UnsupportedSetting(ConfigError):
    """The camera did not apply a setting.

    Attributes:
        device: name of the camera in the cell.
        setting: key of the setting.
        requested: configured value.
        given: value read back from the device; None if it has no such setting.
    """

    def __init__(self, device: str, setting: str, requested: object, given: object) -> None:
        reason = "the camera has no such setting" if given is None else f"the camera gives {given}"
        super().__init__(
            f"{requested} refused, {reason}",
            key=f"{device}.{setting}",
            value=requested,
            hint="leave it out" if given is None else "`v4l2-ctl --list-ctrls --list-formats-ext` shows what it offers",
        )
        self.device = device
        self.setting = setting
        self.requested = requested
        self.given = given


@dataclass(frozen=True, slots=True)
class RawFrame:
    """An undecoded frame as received.

    Attributes:
        data: its bytes, in the configured pixel format.
        t_ns: timestamp.
        seq: sequence number, continuous over restarts of the stream.
        t_device_ns: timestamp of the device's own clock, if that is not ``t_ns``.
        quality: SUSPECT without a trustworthy timestamp.
    """

    data: bytes
    t_ns: int
    seq: int
    t_device_ns: int | None = None
    quality: Quality = Quality.GOOD


class Camera(Device):
    """Base class of live cameras; one thread reads frames, and another may ask for ``health`` meanwhile.

    Frames flow from READY on; ACTIVE adds nothing, because a camera moves nothing. ``configure`` applies the settings.
    The camera is FAULTED when it is disconnected, silent for ``stall_s``, sends more than 10 bad frames in 30, or makes
    frames at a rate that differs from ``rate_hz`` by more than 10 %.

    Args:
        name: the device's name in the cell.
        clock: injected clock; must be CLOCK_MONOTONIC for a device whose frames the kernel stamps.
        config: settings.
    """

    def __init__(self, name: str, clock: Clock, config: CameraConfig) -> None:
        super().__init__(name, clock)
        self._config = config
        self._monitor = FrameMonitor(name)
        self._rate = FrameRate(config.rate_hz)
        self._newest: RawFrame | None = None
        self._last_seq = -1
        self._decoded: Stamped[Frame] | None = None
        self._since_ns = 0
        self._overflowed = False
        self._at_queue = threading.Lock()

    @final
    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Return the newest frame.

        Never blocks, except after a pause so long that the queue overflowed: then up to four periods for a new frame.

        Raises:
            StaleData: the frame is older than ``max_age_s``, or than ``stall_s`` if that is None.
            CorruptMessage: the frame cannot be decoded; it is counted as bad.
            DeviceGone: the camera is disconnected and now FAULTED. Silence for ``stall_s`` (TransportTimeout) and too
                many bad frames (CorruptMessage) also make it FAULTED.
            LifecycleError: not READY or ACTIVE.
        """
        self._require("read frames", Lifecycle.READY, Lifecycle.ACTIVE)
        with self._at_queue:
            self._attempt(self._refresh)
        age_s = self._age_s()
        limit_s = self._config.stall_s if max_age_s is None else max_age_s
        if self._newest is None or age_s > limit_s:
            raise StaleData(self.name, age_s, limit_s, self._last_seq)
        return self._read(self._newest)

    @final
    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """Return the newest frame if its ``seq > after_seq``, else wait for the next one.

        Raises:
            TransportTimeout: none arrived within ``timeout_s``.
            CorruptMessage: the frame cannot be decoded; it is counted as bad.
            DeviceGone: the camera is disconnected and now FAULTED. Silence for ``stall_s`` (TransportTimeout) and too
                many bad frames (CorruptMessage) also make it FAULTED.
            LifecycleError: not READY or ACTIVE.
        """
        self._require("read frames", Lifecycle.READY, Lifecycle.ACTIVE)
        with self._at_queue:
            self._attempt(lambda: self._await_after(after_seq, timeout_s, self._config.stall_s))
        if self._newest is None or self._newest.seq <= after_seq:
            raise TransportTimeout(self.name, f"frame after {after_seq}", timeout_s)
        return self._read(self._newest)

    @final
    def health(self) -> dict[str, float | int | str | bool]:
        """Return frame counters (good, lost, unread, frozen, bad), brightness and its drift, settings as read back."""
        if self._state in (Lifecycle.READY, Lifecycle.ACTIVE):
            try:
                with self._at_queue:
                    self._refresh()
                    self._verify()
            except DeviceError as error:
                self._to_faulted(error)
        return {
            "state": self._state.value,
            "frame_age_s": self._age_s(),
            "frame_rate_hz": self._rate.measured_hz,
            **self._monitor.readings(),
            **self._settings(),
        }

    def _begin_stream(self) -> None:
        """Wait for the first good frame; call once the stream runs. Raises TransportTimeout, DeviceGone."""
        self._monitor.reset_errors()
        self._rate = FrameRate(self._config.rate_hz)
        self._overflowed = False
        self._since_ns = self._clock.now_ns()
        before = self._last_seq
        self._await_after(before, _FIRST_FRAME_S, _FIRST_FRAME_S)
        if self._last_seq == before:
            raise TransportTimeout(self.name, "first frame", _FIRST_FRAME_S, hint="is the camera in use elsewhere?")

    def _store(self, frame: RawFrame) -> None:
        """Store a good frame; ``_collect`` calls this in order of arrival."""
        self._newest = frame
        self._last_seq = frame.seq

    def _age_s(self) -> float:
        t_ns = self._newest.t_ns if self._newest else self._since_ns
        return (self._clock.now_ns() - t_ns) * 1e-9

    def _refresh(self) -> None:
        self._empty_queue()
        self._check_stream(self._config.stall_s)

    def _silence_s(self) -> float:
        # Counted from the latest event: the newest frame may date from before a recovery or an overflow.
        return min(self._age_s(), (self._clock.now_ns() - self._since_ns) * 1e-9)

    def _empty_queue(self) -> None:
        now_ns = self._clock.now_ns()
        give_up_ns = now_ns + round(_UNREAD_PERIODS / self._config.rate_hz * 1e9)
        overflowed = self._collect()
        if overflowed and not self._overflowed:
            # A full queue stops the camera, so silence counts from now.
            self._since_ns = now_ns
        while overflowed and (left_ns := give_up_ns - self._clock.now_ns()) > 0:
            self._wait(left_ns * 1e-9)
            overflowed = self._collect()
        self._overflowed = overflowed

    def _await_after(self, after_seq: int, timeout_s: float, stall_s: float) -> None:
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._empty_queue()
        self._check_stream(stall_s)
        while self._newest is None or self._newest.seq <= after_seq:
            left_s = (deadline_ns - self._clock.now_ns()) * 1e-9
            if left_s <= 0.0:
                return
            self._wait(min(left_s, max(stall_s - self._silence_s(), _SHORTEST_WAIT_S)))
            self._collect()
            self._check_stream(stall_s)

    def _check_stream(self, stall_s: float) -> None:
        if self._monitor.has_too_many_bad:
            worst = max(self._monitor.bad, key=lambda reason: self._monitor.bad[reason])
            raise CorruptMessage(
                self.name, f"too many bad frames, most of them {worst}", hint="check the cable and the USB bandwidth"
            )
        if self._rate.is_broken:
            raise DeviceFault(
                self.name,
                f"makes {self._rate.measured_hz:.1f} frames/s, not {self._config.rate_hz:g}",
                vendor_code="frame rate",
                fault_class=FaultClass.CONFIGURATION,
                needs=Remedy.OPERATOR,
                hint="in the dark cameras expose longer than a frame: set exposure_us, or rate_hz to what it delivers",
            )
        if self._silence_s() > stall_s:
            raise TransportTimeout(self.name, "good frame", stall_s, hint="unplug the camera and plug it in again")

    def _read(self, raw: RawFrame) -> Stamped[Frame]:
        if self._decoded is None or self._decoded.seq != raw.seq:
            try:
                image = self._decode(raw)
            except CorruptMessage:
                self._monitor.count_bad("undecodable")
                self._newest = None
                raise
            self._monitor.record_brightness(image)
            frame = Frame(image, *self._exposure_and_gain())
            self._decoded = Stamped(frame, raw.t_ns, raw.seq, raw.t_device_ns, raw.quality)
        return self._decoded

    def _decode(self, raw: RawFrame) -> ImageArray:
        config = self._config
        grey = config.color == "grey"
        pixels = np.frombuffer(raw.data, np.uint8)
        if config.pixel_format != "MJPG":
            pixels = pixels.reshape(config.height_px, config.width_px, -1)
            if grey:
                return pixels[:, :, 0].copy()
        import cv2

        if config.pixel_format == "GREY":
            return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), np.uint8)
        if config.pixel_format == "YUYV":
            return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2BGR_YUYV), np.uint8)
        image = cv2.imdecode(pixels, cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR)
        if image is None or image.shape[:2] != (config.height_px, config.width_px):
            raise CorruptMessage(self.name, f"frame {raw.seq} cannot be decoded")
        return np.asarray(image, np.uint8)

    @final
    def _recover(self, token: OperatorToken) -> None:
        self._close()
        try:
            self._open()
            self._configure()
        except BaseException:
            self._close()
            raise

    def _verify(self) -> None:
        """Raise DeviceFault if a setting no longer holds; called by ``health``."""

    @abstractmethod
    def _collect(self) -> bool:
        """Take every waiting frame and ``_store`` the good ones; True if an overflow followed the newest one."""

    @abstractmethod
    def _wait(self, timeout_s: float) -> None:
        """Return when a frame is available or after ``timeout_s``. Raises DeviceGone."""

    @abstractmethod
    def _exposure_and_gain(self) -> tuple[float | None, float | None]:
        """Return exposure time in s and gain as read back, None where unknown."""

    @abstractmethod
    def _settings(self) -> dict[str, float | int | str | bool]:
        """Return the settings as read back, and warnings, for ``health``."""
