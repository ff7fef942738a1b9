"""Driver for TacTip cameras with Video4Linux2: kernel timestamps, sequence numbers, settings read back.

Source: the kernel's "Video for Linux API", chapters "Streaming I/O (Memory Mapping)" and "User Controls".
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from touchcell.drivers.core.camera import Camera, CameraConfig, RawFrame, UnsupportedSetting, camera_behaviour
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.diagnosis import Finding
from touchcell.drivers.core.errors import ConnectError, DeviceFault, DeviceGone, FaultClass, Remedy, TransportError
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.samples import Quality
from touchcell.drivers.core.spec import Capabilities, DriverContext, DriverSpec
from touchcell.drivers.v4l2 import codec
from touchcell.drivers.v4l2.node import KernelCalls, SystemCalls, VideoNode
from touchcell.drivers.v4l2.shim import EMULATED_CAMERAS, ShimCalls

_LONGEST_PAUSE_S = 0.5
_FEWEST_BUFFERS = 4
_SETTINGS_CHECKED_WITHIN_NS = 2_000_000_000
_RATE_TOLERANCE = 0.01
_FUTURE_NS = 1_000_000
_DELAYS = 60
_CLOCK_TOLERANCE_NS = 1_000_000_000
_AUTOMATICS = (
    (codec.CID_EXPOSURE_AUTO, "automatic exposure", codec.EXPOSURE_MANUAL),
    (codec.CID_EXPOSURE_AUTO_PRIORITY, "dynamic frame rate", 0),
    (codec.CID_AUTOGAIN, "automatic gain", 0),
    (codec.CID_AUTO_WHITE_BALANCE, "automatic white balance", 0),
)
_BYTES_PER_PIXEL = {"YUYV": 2, "GREY": 1}


class V4l2Config(CameraConfig):
    """Settings of a V4L2 camera; see ``CameraConfig``.

    Attributes:
        expect_bus: USB address that the camera must have, as ``touchcell devices`` shows it; None accepts any. For
            cameras with equal names and serial numbers, which the system may exchange.
    """

    expect_bus: str | None = None


class V4l2Camera(Camera):
    """Driver for the camera of a video node.

    The queue holds half a second of frames (at most 32, the kernel's limit), so any control loop that reads at least
    that often gets the newest frame without a reader thread.

    Args:
        name: the device's name in the cell.
        clock: injected clock; must be CLOCK_MONOTONIC, as the kernel's timestamps are.
        config: settings.
        calls: system calls; the kernel's by default.
    """

    _config: V4l2Config

    def __init__(self, name: str, clock: Clock, config: V4l2Config, calls: SystemCalls | None = None) -> None:
        super().__init__(name, clock, config)
        self._calls = calls or KernelCalls()
        self._node: VideoNode | None = None
        self._identity: tuple[str, str, str] | None = None
        self._fixed: dict[int, tuple[str, int]] = {}
        self._buffers = 0
        self._overrun = False
        self._previous: codec.Arrival | None = None
        self._delays_ns: deque[int] = deque(maxlen=_DELAYS)
        self._number = -1
        self._queue_empty_ns = 0
        self._next_check_ns = 0
        self._checked = 0
        self._exposure_us: int | None = None
        self._gain: int | None = None

    def _open(self) -> None:
        if abs(self._clock.now_ns() - self._calls.now_ns()) > _CLOCK_TOLERANCE_NS:
            raise ConnectError(
                self.name,
                "the kernel stamps frames on CLOCK_MONOTONIC, but the cell's clock is another",
                hint="use a simulated or replayed camera with a virtual clock",
            )
        node = self._node = VideoNode(self.name, self._config.device, self._calls)
        expected = self._config.expect_bus
        if expected is not None and node.bus != expected:
            raise ConnectError(
                self.name,
                f"{self._config.device} is the camera at {node.bus}, not at {expected}",
                hint="has it moved to another socket, or were two cameras exchanged?",
            )
        found = (node.card, node.bus, node.serial)
        if self.state is Lifecycle.FAULTED and self._identity is not None and found != self._identity:
            raise ConnectError(
                self.name,
                f"another camera answers: {_described(found)}, it was {_described(self._identity)}",
                hint="plug the same camera into the same socket; disconnect and connect if this one is right",
            )
        self._identity = found

    def _close(self) -> None:
        if self._node is not None:
            self._node.close()
            self._node = None

    def _configure(self) -> None:
        node = self._opened()
        self._set_format(node)
        self._set_controls(node)
        try:
            depth = math.ceil(_LONGEST_PAUSE_S * self._config.rate_hz)
            self._buffers = node.start(min(max(depth, _FEWEST_BUFFERS), codec.MAX_BUFFERS))
            if self._buffers < 2:
                raise ConnectError(
                    self.name, f"the camera grants {self._buffers} buffers", hint="at least two are needed"
                )
            self._previous = None
            self._delays_ns.clear()
            self._overrun = False
            self._queue_empty_ns = self._clock.now_ns()
            self._begin_stream()
            self._check_settings(node)
        except BaseException:
            node.stop()
            raise

    def _set_format(self, node: VideoNode) -> None:
        config = self._config
        applied = node.set_format(config.pixel_format, config.width_px, config.height_px)
        for setting, given in (
            ("pixel_format", applied.pixel_format),
            ("width_px", applied.width_px),
            ("height_px", applied.height_px),
        ):
            if given != getattr(config, setting):
                raise UnsupportedSetting(self.name, setting, getattr(config, setting), given)
        line = config.width_px * _BYTES_PER_PIXEL.get(config.pixel_format, 0)
        if line and applied.bytes_per_line != line:
            raise UnsupportedSetting(
                self.name, "pixel_format", config.pixel_format, f"lines of {applied.bytes_per_line} bytes"
            )
        rate_hz = node.set_rate(config.rate_hz)
        # A camera of one fixed rate has no such setting: whether it delivers this rate is measured.
        if rate_hz is not None and not math.isclose(rate_hz, config.rate_hz, rel_tol=_RATE_TOLERANCE):
            raise UnsupportedSetting(self.name, "rate_hz", config.rate_hz, rate_hz)

    def _set_controls(self, node: VideoNode) -> None:
        self._fixed = {}
        for identity, setting, value in _AUTOMATICS:
            if node.has_control(identity):
                self._expect(setting, value, node.set_control(identity, value))
                self._fixed[identity] = setting, value
        config = self._config
        unit = codec.EXPOSURE_UNIT_US
        steps = None if config.exposure_us is None else config.exposure_us // unit
        steps = self._set_value(node, codec.CID_EXPOSURE_ABSOLUTE, "exposure_us", steps, unit)
        self._exposure_us = None if steps is None else steps * unit
        if self._exposure_us is not None and self._exposure_us * config.rate_hz > 1e6:
            raise UnsupportedSetting(self.name, "exposure_us", f"at most {1e6 / config.rate_hz:.0f}", self._exposure_us)
        self._gain = self._set_value(node, codec.CID_GAIN, "gain", config.gain, 1)

    def _set_value(self, node: VideoNode, identity: int, setting: str, value: int | None, unit: int) -> int | None:
        if not node.has_control(identity):
            if value is not None:
                raise UnsupportedSetting(self.name, setting, value * unit, None)
            return None
        given = node.control(identity) if value is None else node.set_control(identity, value)
        if value is not None:
            self._expect(setting, value * unit, None if given is None else given * unit)
        if given is not None:
            self._fixed[identity] = setting, given
        return given

    def _check_settings(self, node: VideoNode) -> None:
        """Read every control back while the stream runs: some cameras reset them when it starts, or later."""
        for identity in self._fixed:
            self._check_setting(node, identity)

    def _check_setting(self, node: VideoNode, identity: int) -> None:
        setting, value = self._fixed[identity]
        found = node.control(identity)
        if found is not None and found != value:
            raise DeviceFault(
                self.name,
                f"{setting} has changed from {value} to {found} by itself",
                vendor_code=setting,
                fault_class=FaultClass.CONFIGURATION,
                needs=Remedy.OPERATOR,
                hint="does another program use the camera? a camera that forgets its settings cannot be used",
            )

    def _check_next_setting(self) -> None:
        # One at a time: a control request to a USB camera takes some milliseconds.
        if not self._fixed or self._clock.now_ns() < self._next_check_ns:
            return
        self._next_check_ns = self._clock.now_ns() + _SETTINGS_CHECKED_WITHIN_NS // len(self._fixed)
        self._checked += 1
        self._check_setting(self._opened(), list(self._fixed)[self._checked % len(self._fixed)])

    def _expect(self, setting: str, requested: int, given: int | None) -> None:
        if requested != given:
            raise UnsupportedSetting(self.name, setting, requested, given)

    def _collect(self) -> bool:
        node = self._opened()
        if self.state is not Lifecycle.PASSIVE:
            self._check_next_setting()
        taken = 0
        # Bounded: a camera that is faster than this loop must not block the caller for ever.
        while taken < 2 * self._buffers:
            try:
                arrival = node.take()
            except DeviceGone:
                raise
            except TransportError:
                # DQBUF may fail with EIO for one frame (signal lost) and continue with the next.
                self._monitor.count_bad("unreadable")
                break
            if arrival is None:
                break
            taken += 1
            data = node.data(arrival)
            node.give_back(arrival.index)
            self._examine(arrival, data)
            if taken >= self._buffers:
                self._overrun = True
        self._queue_empty_ns = self._clock.now_ns()
        return self._overrun

    def _examine(self, arrival: codec.Arrival, data: bytes) -> None:
        previous = self._previous
        step = 1 if previous is None else codec.sequence_step(previous.sequence, arrival.sequence)
        was_overrun = self._overrun
        if step <= 0 or (previous is not None and arrival.stamp_ns <= previous.stamp_ns):
            self._monitor.count_bad("out_of_order")
            return
        if arrival.monotonic and arrival.stamp_ns > self._clock.now_ns() + _FUTURE_NS:
            self._monitor.count_bad("from_the_future")
            return
        if arrival.monotonic:
            self._delays_ns.append(self._clock.now_ns() - arrival.stamp_ns)
        self._previous = arrival
        self._number += step
        self._monitor.count_lost(step - 1, overrun=self._overrun)
        self._overrun = False
        if previous is not None and not was_overrun:
            self._rate.note((arrival.stamp_ns - previous.stamp_ns) * 1e-9, step)
        if arrival.damaged:
            self._monitor.count_bad("marked_damaged")
        elif codec.damage(data, self._config.pixel_format, self._config.width_px, self._config.height_px):
            self._monitor.count_bad("damaged")
        else:
            self._monitor.count_good(data)
            self._store(self._stamped(arrival, data))

    def _stamped(self, arrival: codec.Arrival, data: bytes) -> RawFrame:
        if arrival.monotonic:
            return RawFrame(data, arrival.stamp_ns, self._number)
        # Its age is unknown, except that the frame was not there when the queue was last empty.
        return RawFrame(data, self._queue_empty_ns, self._number, arrival.stamp_ns, Quality.SUSPECT)

    def _wait(self, timeout_s: float) -> None:
        self._opened().wait(timeout_s)

    def _exposure_and_gain(self) -> tuple[float | None, float | None]:
        return (
            None if self._exposure_us is None else self._exposure_us * 1e-6,
            None if self._gain is None else float(self._gain),
        )

    def _settings(self) -> dict[str, float | int | str | bool]:
        card, bus, serial = self._identity or ("", "", "")
        readings: dict[str, float | int | str | bool] = {
            "card": card,
            "bus": bus,
            "serial": serial,
            "buffers": self._buffers,
            "stable_name": is_stable_name(self._config.device),
        }
        if self._delays_ns:
            # The least of the latest: the others had to wait for this program.
            readings["delivery_s"] = min(self._delays_ns) * 1e-9
        if self._previous is not None:
            readings["kernel_stamps"] = self._previous.monotonic
            readings["stamp_marks"] = "start of exposure" if self._previous.start_of_exposure else "end of frame"
        if self._exposure_us is not None:
            readings["exposure_us"] = self._exposure_us
        if self._gain is not None:
            readings["gain"] = self._gain
        if not readings["stable_name"]:
            readings["warning"] = f"{self._config.device} may be another camera after a restart, use /dev/v4l/by-id"
        return readings

    def _verify(self) -> None:
        self._check_next_setting()

    def diagnose(self) -> Iterator[Finding]:
        """Yield what is wrong with the camera and the name that it has in the cell file; asks, and sets nothing."""
        node, config = self._opened(), self._config
        formats = node.pixel_formats()
        if config.pixel_format not in formats:
            what = f"does not offer {config.pixel_format}, only {', '.join(formats)}"
            yield Finding(what, "set pixel_format to one of them", ("lerobot 1225", "lerobot 1558"))
        given = node.try_format(config.pixel_format, config.width_px, config.height_px)
        if (given.pixel_format, given.width_px, given.height_px) != (
            config.pixel_format,
            config.width_px,
            config.height_px,
        ):
            what = f"gives {given.pixel_format} {given.width_px} x {given.height_px} for what the cell file asks"
            yield Finding(what, "`v4l2-ctl --list-formats-ext` shows what it offers", ("lerobot 1225", "lerobot 1558"))
        if node.is_busy():
            yield Finding("another program streams from it", "close that program", ("lerobot 3569",))
        if not is_stable_name(config.device):
            what = f"{config.device} may be another camera after a restart or a re-plug"
            yield Finding(what, "use its name under /dev/v4l/by-id or by-path", ("U20CAM-9281M 4", "rosys 69"), False)
        elif not node.serial and config.expect_bus is None and "/by-id/" in config.device:
            what = "has no serial number of its own: a second camera of this make may take its name"
            yield Finding(what, f"set expect_bus: {node.bus}", ("rosys 69", "octoprint_deploy 203"), is_fault=False)
        for identity, setting, _ in _AUTOMATICS:
            if node.has_control(identity) and node.control(identity) is None:
                what = f"its control for {setting} does not answer"
                yield Finding(what, "try another cable or port, or another camera", ("showmewebcam 213",))
        if config.exposure_us is None and node.has_control(codec.CID_EXPOSURE_ABSOLUTE):
            steps = node.control(codec.CID_EXPOSURE_ABSOLUTE)
            if steps is not None and steps * codec.EXPOSURE_UNIT_US * config.rate_hz > 1e6:
                exposure_us = steps * codec.EXPOSURE_UNIT_US
                what = f"its exposure of {exposure_us} us is longer than a frame at {config.rate_hz:g} Hz"
                yield Finding(what, "set exposure_us", ("autonomous-os 79", "picam 133"))

    def _opened(self) -> VideoNode:
        assert self._node is not None, "the lifecycle prevents reading a closed camera"
        return self._node


def _described(identity: tuple[str, str, str]) -> str:
    card, bus, serial = identity
    return f"{card} at {bus}" + (f", serial number {serial}" if serial else "")


def is_stable_name(path: str) -> bool:
    """Return whether a node's name identifies the camera (by-id) or the socket (by-path) across restarts."""
    return path.startswith(("/dev/v4l/by-id/", "/dev/v4l/by-path/"))


def build(name: str, config: V4l2Config, context: DriverContext) -> V4l2Camera:
    """Build a DISCONNECTED camera; an emulated one where the variable of emulated cameras names their folder."""
    folder = os.environ.get(EMULATED_CAMERAS)
    return V4l2Camera(name, context.clock, config, ShimCalls(Path(folder)) if folder else None)


SPEC = DriverSpec(
    name="v4l2",
    summary="TacTip camera through Video4Linux2, with kernel stamps and sequence numbers",
    config=V4l2Config,
    capabilities=Capabilities(kind="camera", provides=frozenset({FrameSource, HealthSource}), state_rate_hz=30.0),
    build=build,
    behaviour=camera_behaviour,
)
