"""Model of a camera's replies to Video4Linux2 requests: formats, controls, priorities, buffers. No sockets.

Behaviour follows the kernel's V4L2 and videobuf2 cores as far as v4l2-compliance tests it.
"""

from __future__ import annotations

import ctypes
import errno
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.v4l2 import codec

S = TypeVar("S", bound=ctypes.Structure)

FORMATS = {"MJPG": "Motion-JPEG", "YUYV": "YUYV 4:2:2", "GREY": "8-bit Greyscale"}
SIZES = ((640, 480), (1280, 720), (320, 240))
RATES_HZ = (30, 60, 120)
SLOT_BYTES = 2 << 20
"""Size reserved per buffer in the shared memory; also the step of the mmap offsets."""

_INTEGER, _BOOLEAN, _MENU, _CLASS = 1, 2, 3, 6
_COLORSPACE_SRGB = 8
_PIX_PRIV_MAGIC = 0xFEEDCAFE
_DESCRIBED_COMPRESSED = 1
_DISCRETE = 1
_INPUT_CAMERA = 2
_CAP_META_CAPTURE = 0x00800000
_EVENT_ALL, _EVENT_CONTROL = 0, 3
_EVENT_SEND_INITIAL, _EVENT_ALLOW_FEEDBACK = 1, 2
_EVENT_VALUE, _EVENT_FLAGS = 1, 2
_PRIORITY_INTERACTIVE, _PRIORITY_RECORD = 2, 3
_WHICH_CURRENT, _WHICH_DEFAULT = 0, 0x0F000000
_CLASS_MASK = 0x0FFF0000
_FOCUS_ABSOLUTE = 0x009A090A
_BUFFERS_MMAP, _BUFFERS_ORPHANED = 1, 1 << 4
_GUARDED = frozenset(
    {
        codec.S_INPUT,
        codec.S_FMT,
        codec.S_PARM,
        codec.S_CTRL,
        codec.S_EXT_CTRLS,
        codec.REQBUFS,
        codec.STREAMON,
        codec.STREAMOFF,
    }
)
"""Requests that are refused while another handle has a higher priority."""

_CHANGING = frozenset({codec.S_FMT, codec.S_PARM, codec.S_CTRL, codec.S_EXT_CTRLS, codec.S_INPUT, codec.STREAMON})


@dataclass(slots=True)
class ControlState:
    """One control of the camera."""

    name: str
    kind: int
    minimum: int = 0
    maximum: int = 0
    step: int = 0
    default: int = 0
    menu: dict[int, str] = field(default_factory=dict)
    value: int = 0

    def nearest(self, value: int) -> int:
        """Return ``value`` clamped and rounded to a step, as the kernel's control framework does."""
        value = max(self.minimum, min(self.maximum, value))
        return self.minimum + (value - self.minimum + self.step // 2) // self.step * self.step


def controls() -> dict[int, ControlState]:
    """Return the controls of a typical USB camera, at their defaults."""
    table = {
        0x00980001: ControlState("User Controls", _CLASS),
        0x00980900: ControlState("Brightness", _INTEGER, -64, 64, 1, 0),
        0x00980901: ControlState("Contrast", _INTEGER, 0, 64, 1, 32),
        codec.CID_AUTO_WHITE_BALANCE: ControlState("White Balance, Automatic", _BOOLEAN, 0, 1, 1, 1),
        codec.CID_GAIN: ControlState("Gain", _INTEGER, 0, 100, 1, 0),
        0x009A0001: ControlState("Camera Controls", _CLASS),
        codec.CID_EXPOSURE_AUTO: ControlState(
            "Auto Exposure", _MENU, 0, 3, 1, 3, {1: "Manual Mode", 3: "Aperture Priority Mode"}
        ),
        codec.CID_EXPOSURE_ABSOLUTE: ControlState("Exposure Time, Absolute", _INTEGER, 1, 5000, 1, 157),
        codec.CID_EXPOSURE_AUTO_PRIORITY: ControlState("Exposure, Dynamic Framerate", _BOOLEAN, 0, 1, 1, 1),
        _FOCUS_ABSOLUTE: ControlState("Focus, Absolute", _INTEGER, 0, 250, 5, 0),
    }
    for control in table.values():
        control.value = control.default
    return table


@dataclass(eq=False, slots=True)
class Handle:
    """One open file handle: its priority, subscribed and pending events."""

    priority: int = _PRIORITY_INTERACTIVE
    subscribed: dict[int, int] = field(default_factory=dict)
    events: deque[codec.Event] = field(default_factory=lambda: deque(maxlen=64))
    event_count: int = 0


class Refused(Exception):
    """A request fails with an errno."""

    def __init__(self, number: int) -> None:
        super().__init__(errno.errorcode[number])
        self.number = number


class CameraModel:
    """State and replies of one emulated camera.

    Args:
        card: product name.
        bus: USB address.
        on_stream: called with True when streaming starts and False when it ends.

    Attributes:
        settings_changed: number of requests that changed anything or started the stream.
        energising: settings of a control with an actuator, which on this camera is the focus.
    """

    def __init__(self, card: str, bus: str, on_stream: Callable[[bool], None]) -> None:
        self.card = card
        self.bus = bus
        self._on_stream = on_stream
        self.pixel_format, self.width, self.height, self.rate_hz = "YUYV", 640, 480, 30
        self.controls = controls()
        self.handles: set[Handle] = set()
        self.owner: Handle | None = None
        self.buffers = 0
        self.queued: deque[int] = deque()
        self.streaming = False
        self.stuck_controls = False
        self.forgetful = False
        self.fixed_rate = False
        self.no_bandwidth = False
        self.only_format: tuple[str, int, int] | None = None
        self.granted_rate_hz: float | None = None
        self.control_error = 0
        self.busy = False
        self.is_metadata = False
        self.stamp_flags = codec.BUF_TIMESTAMP_MONOTONIC | codec.BUF_STAMP_START_OF_EXPOSURE
        self.requests: Counter[str] = Counter()
        self.settings_changed = 0
        self.energising = 0
        self.last_command_ns = 0

    @property
    def exposure_s(self) -> float:
        """Exposure time: 0 while it is automatic, in good light."""
        if self.controls[codec.CID_EXPOSURE_AUTO].value != codec.EXPOSURE_MANUAL:
            return 0.0
        return self.controls[codec.CID_EXPOSURE_ABSOLUTE].value * codec.EXPOSURE_UNIT_US * 1e-6

    def reset_controls(self) -> None:
        """Return every control to its default."""
        for control in self.controls.values():
            control.value = control.default

    @property
    def frame_bytes(self) -> int:
        """Size of a buffer."""
        return self.width * self.height * (1 if self.pixel_format == "GREY" else 2)

    def answer(self, handle: Handle, request: int, body: bytearray) -> int:
        """Execute ``request``, changing ``body`` in place; return 0 or an errno."""
        handler = _HANDLERS.get(request)
        self.requests[_NAMES.get(request, hex(request))] += 1
        if handler is None:
            return errno.ENOTTY
        if request in _CHANGING:
            self.settings_changed += 1
            self.last_command_ns = emulated_clock().now_ns()
        try:
            if request in _GUARDED and handle.priority < max(other.priority for other in self.handles):
                raise Refused(errno.EBUSY)
            handler(self, handle, body)
        except Refused as refused:
            return refused.number
        return 0

    def release(self, handle: Handle) -> None:
        """Release a closed handle."""
        self.handles.discard(handle)
        if self.owner is handle:
            self._stop()
            self.owner, self.buffers = None, 0

    def next_buffer(self) -> int | None:
        """Take the buffer for the next frame, or None if the program has queued none."""
        return self.queued.popleft() if self.queued else None

    def filled(self, index: int, used: int, sequence: int, stamp_ns: int, flags: int) -> codec.Buffer:
        """Return the buffer as DQBUF shall deliver it."""
        buffer = self._buffer(index)
        buffer.bytesused, buffer.sequence, buffer.field = used, sequence, codec.FIELD_NONE
        buffer.seconds, buffer.microseconds = stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000 // 1000
        buffer.flags = codec.BUF_MAPPED | self.stamp_flags | flags
        return buffer

    def _query_capability(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.Capability, body)
        reply.driver, reply.card, reply.bus_info = b"touchcell", self.card.encode(), self.bus.encode()
        reply.version = 0x00060100
        reply.device_caps = codec.CAP_VIDEO_CAPTURE | codec.CAP_STREAMING | codec.CAP_EXT_PIX_FORMAT
        if self.is_metadata:
            reply.device_caps = _CAP_META_CAPTURE | codec.CAP_STREAMING
        reply.capabilities = reply.device_caps | codec.CAP_DEVICE_CAPS

    def _enum_formats(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.FormatDescription, body, "index", "type")
        if reply.type != codec.VIDEO_CAPTURE or reply.index >= len(FORMATS):
            raise Refused(errno.EINVAL)
        name = list(FORMATS)[reply.index]
        reply.pixelformat, reply.description = codec.fourcc(name), FORMATS[name].encode()
        reply.flags = _DESCRIBED_COMPRESSED if name == "MJPG" else 0

    def _enum_sizes(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.FrameSize, body, "index", "pixel_format")
        if codec.fourcc_text(reply.pixel_format) not in FORMATS or reply.index >= len(SIZES):
            raise Refused(errno.EINVAL)
        reply.type = _DISCRETE
        reply.width, reply.height = SIZES[reply.index]

    def _enum_intervals(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.FrameInterval, body, "index", "pixel_format", "width", "height")
        known = codec.fourcc_text(reply.pixel_format) in FORMATS and (reply.width, reply.height) in SIZES
        if not known or reply.index >= len(RATES_HZ):
            raise Refused(errno.EINVAL)
        reply.type = _DISCRETE
        reply.discrete = codec.Fraction(1, RATES_HZ[reply.index])

    def _get_format(self, handle: Handle, body: bytearray) -> None:
        self._describe_format(body, self.pixel_format, self.width, self.height)

    def _try_format(self, handle: Handle, body: bytearray) -> None:
        self._describe_format(body, *(self.only_format or _nearest_format(body)))

    def _set_format(self, handle: Handle, body: bytearray) -> None:
        wanted = self.only_format or _nearest_format(body)
        self._describe_format(body, *wanted)
        if self.buffers:
            raise Refused(errno.EBUSY)
        self.pixel_format, self.width, self.height = wanted

    def _describe_format(self, body: bytearray, pixel_format: str, width: int, height: int) -> None:
        reply = _fresh(codec.Format, body, "type")
        if reply.type != codec.VIDEO_CAPTURE:
            raise Refused(errno.EINVAL)
        per_pixel = 1 if pixel_format == "GREY" else 2
        pix = reply.pix
        pix.width, pix.height, pix.pixelformat = width, height, codec.fourcc(pixel_format)
        pix.field, pix.colorspace, pix.priv = codec.FIELD_NONE, _COLORSPACE_SRGB, _PIX_PRIV_MAGIC
        pix.bytesperline = 0 if pixel_format == "MJPG" else width * per_pixel
        pix.sizeimage = width * height * per_pixel

    def _get_parameters(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.StreamParameters, body, "type")
        if reply.type != codec.VIDEO_CAPTURE:
            raise Refused(errno.EINVAL)
        reply.capability = codec.CAP_TIMEPERFRAME
        granted_hz = self.granted_rate_hz
        reply.timeperframe = (
            codec.Fraction(1, self.rate_hz) if granted_hz is None else codec.Fraction(1000, round(1000 * granted_hz))
        )

    def _set_parameters(self, handle: Handle, body: bytearray) -> None:
        request_body = codec.StreamParameters.from_buffer_copy(body)
        if self.fixed_rate:
            raise Refused(errno.ENOTTY)
        if request_body.type == codec.VIDEO_CAPTURE:
            if self.streaming:
                raise Refused(errno.EBUSY)
            period = request_body.timeperframe
            if period.numerator and period.denominator:
                wanted_hz = period.denominator / period.numerator
                self.rate_hz = min(RATES_HZ, key=lambda rate_hz: abs(rate_hz - wanted_hz))
        self._get_parameters(handle, body)

    def _enum_input(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.Input, body, "index")
        if reply.index:
            raise Refused(errno.EINVAL)
        reply.name, reply.type = b"Camera 1", _INPUT_CAMERA

    def _get_input(self, handle: Handle, body: bytearray) -> None:
        ctypes.c_int32.from_buffer(body).value = 0

    def _set_input(self, handle: Handle, body: bytearray) -> None:
        if ctypes.c_int32.from_buffer(body).value != 0:
            raise Refused(errno.EINVAL)

    def _get_priority(self, handle: Handle, body: bytearray) -> None:
        ctypes.c_uint32.from_buffer(body).value = max(other.priority for other in self.handles)

    def _set_priority(self, handle: Handle, body: bytearray) -> None:
        wanted = ctypes.c_uint32.from_buffer(body).value
        if not 1 <= wanted <= _PRIORITY_RECORD:
            raise Refused(errno.EINVAL)
        if any(other.priority == _PRIORITY_RECORD for other in self.handles if other is not handle):
            raise Refused(errno.EBUSY)
        handle.priority = wanted

    def _request_buffers(self, handle: Handle, body: bytearray) -> None:
        request_body = codec.RequestBuffers.from_buffer_copy(body)
        if request_body.type != codec.VIDEO_CAPTURE or request_body.memory != codec.MEMORY_MMAP:
            raise Refused(errno.EINVAL)
        if self.owner not in (None, handle) or self.streaming or self.busy:
            raise Refused(errno.EBUSY)
        reply = _fresh(codec.RequestBuffers, body, "type", "memory")
        reply.count = self.buffers = min(request_body.count, codec.MAX_BUFFERS)
        reply.capabilities = _BUFFERS_MMAP | _BUFFERS_ORPHANED
        self.owner = handle if self.buffers else None
        self.queued.clear()

    def _query_buffer(self, handle: Handle, body: bytearray) -> None:
        request_body = codec.Buffer.from_buffer_copy(body)
        if request_body.type != codec.VIDEO_CAPTURE or request_body.index >= self.buffers:
            raise Refused(errno.EINVAL)
        reply = self._buffer(request_body.index)
        reply.flags = (
            codec.BUF_MAPPED | self.stamp_flags | (codec.BUF_QUEUED if request_body.index in self.queued else 0)
        )
        body[:] = bytes(reply)

    def _queue_buffer(self, handle: Handle, body: bytearray) -> None:
        index = codec.Buffer.from_buffer_copy(body).index
        if handle is self.owner and index < self.buffers and index not in self.queued:
            self.queued.append(index)

    def _stream_on(self, handle: Handle, body: bytearray) -> None:
        if ctypes.c_int32.from_buffer(body).value != codec.VIDEO_CAPTURE or not self.buffers:
            raise Refused(errno.EINVAL)
        if handle is not self.owner:
            raise Refused(errno.EBUSY)
        if self.no_bandwidth:
            raise Refused(errno.ENOSPC)
        if not self.streaming:
            self.streaming = True
            if self.forgetful:
                self.reset_controls()
            self._on_stream(True)

    def _stream_off(self, handle: Handle, body: bytearray) -> None:
        if ctypes.c_int32.from_buffer(body).value != codec.VIDEO_CAPTURE:
            raise Refused(errno.EINVAL)
        if self.owner not in (None, handle):
            raise Refused(errno.EBUSY)
        self._stop()

    def _stop(self) -> None:
        self.queued.clear()
        if self.streaming:
            self.streaming = False
            self._on_stream(False)

    def _buffer(self, index: int) -> codec.Buffer:
        return codec.Buffer(
            index=index,
            type=codec.VIDEO_CAPTURE,
            memory=codec.MEMORY_MMAP,
            offset=index * SLOT_BYTES,
            length=self.frame_bytes,
        )

    def _flags(self, identity: int) -> int:
        if self.controls[identity].kind == _CLASS:
            return codec.CTRL_READ_ONLY | 0x40
        manual = self.controls[codec.CID_EXPOSURE_AUTO].value == codec.EXPOSURE_MANUAL
        if identity == codec.CID_EXPOSURE_AUTO:
            return codec.CTRL_UPDATE
        return codec.CTRL_INACTIVE if identity == codec.CID_EXPOSURE_ABSOLUTE and not manual else 0

    def _find_control(self, identity: int) -> int:
        if identity & (codec.CTRL_NEXT | codec.CTRL_NEXT_COMPOUND):
            if not identity & codec.CTRL_NEXT:
                raise Refused(errno.EINVAL)
            later = [known for known in sorted(self.controls) if known > identity & 0x0FFFFFFF]
            if not later:
                raise Refused(errno.EINVAL)
            return later[0]
        if identity not in self.controls:
            raise Refused(errno.EINVAL)
        return identity

    def _query_control(self, handle: Handle, body: bytearray) -> None:
        self._describe_control(codec.QueryControl, body)

    def _query_extended(self, handle: Handle, body: bytearray) -> None:
        reply = self._describe_control(codec.QueryExtendedControl, body)
        reply.elem_size, reply.elems = 4, 1

    def _describe_control(self, layout: type[S], body: bytearray) -> S:
        identity = self._find_control(layout.from_buffer_copy(body).id)
        control = self.controls[identity]
        reply = _fresh(layout, body)
        reply.id, reply.type, reply.name, reply.flags = (
            identity,
            control.kind,
            control.name.encode(),
            self._flags(identity),
        )
        reply.minimum, reply.maximum = control.minimum, control.maximum
        reply.step, reply.default_value = control.step, control.default
        return reply

    def _query_menu(self, handle: Handle, body: bytearray) -> None:
        reply = _fresh(codec.QueryMenu, body, "id", "index")
        if reply.id not in self.controls or reply.index not in self.controls[reply.id].menu:
            raise Refused(errno.EINVAL)
        reply.name = self.controls[reply.id].menu[reply.index].encode()

    def _get_control(self, handle: Handle, body: bytearray) -> None:
        self._fail_if_broken()
        request = codec.Control.from_buffer(body)
        request.value = self._readable(request.id).value

    def _fail_if_broken(self) -> None:
        if self.control_error:
            raise Refused(self.control_error)

    def _set_control(self, handle: Handle, body: bytearray) -> None:
        self._fail_if_broken()
        request = codec.Control.from_buffer(body)
        self._check(request.id, request.value)
        request.value = self._store(handle, request.id, request.value)

    def _readable(self, identity: int) -> ControlState:
        if identity not in self.controls:
            raise Refused(errno.EINVAL)
        if self.controls[identity].kind == _CLASS:
            raise Refused(errno.EACCES)
        return self.controls[identity]

    def _check(self, identity: int, value: int) -> None:
        control = self._readable(identity)
        if control.kind == _MENU and not control.minimum <= value <= control.maximum:
            raise Refused(errno.ERANGE)
        if control.kind == _MENU and value not in control.menu:
            raise Refused(errno.EINVAL)

    def _store(self, handle: Handle, identity: int, value: int) -> int:
        control = self.controls[identity]
        if identity == _FOCUS_ABSOLUTE:
            self.energising += 1
        if not self.stuck_controls:
            control.value = control.nearest(value)
            self._notify_others(handle, identity, _EVENT_VALUE)
            if identity == codec.CID_EXPOSURE_AUTO:
                self._notify_others(handle, codec.CID_EXPOSURE_ABSOLUTE, _EVENT_FLAGS)
        return control.value

    def _get_extended(self, handle: Handle, body: bytearray) -> None:
        header, items = self._extended(body)
        for item in items:
            control = self.controls[item.id]
            item.value64 = control.default if header.which == _WHICH_DEFAULT else control.value

    def _try_extended(self, handle: Handle, body: bytearray) -> None:
        _, items = self._extended(body, setting=True)
        for item in items:
            item.value64 = self.controls[item.id].nearest(_low_word(item))

    def _set_extended(self, handle: Handle, body: bytearray) -> None:
        try:
            _, items = self._extended(body, setting=True)
        except Refused:
            # An index past the end means that no control has been set yet.
            header = codec.ExtendedControls.from_buffer(body)
            header.error_idx = header.count
            raise
        for item in items:
            item.value64 = self._store(handle, item.id, _low_word(item))

    def _extended(
        self, body: bytearray, *, setting: bool = False
    ) -> tuple[codec.ExtendedControls, list[codec.ExtendedControl]]:
        header = codec.ExtendedControls.from_buffer(body)
        header.error_idx, header.reserved = header.count, 0
        start, size = ctypes.sizeof(codec.ExtendedControls), ctypes.sizeof(codec.ExtendedControl)
        items = [codec.ExtendedControl.from_buffer(body, start + size * at) for at in range(header.count)]
        classes = {identity & _CLASS_MASK for identity in self.controls}
        plain = header.which in (_WHICH_CURRENT, _WHICH_DEFAULT)
        if (not plain and header.which not in classes) or (setting and header.which == _WHICH_DEFAULT):
            raise Refused(errno.EINVAL)
        for position, item in enumerate(items):
            if not plain and item.id & _CLASS_MASK != header.which:
                raise Refused(errno.EINVAL)
            if setting:
                header.error_idx = position
                self._check(item.id, _low_word(item))
            self._readable(item.id)
        header.error_idx = header.count
        return header, items

    def _subscribe(self, handle: Handle, body: bytearray) -> None:
        wanted = codec.EventSubscription.from_buffer_copy(body)
        if wanted.type != _EVENT_CONTROL or wanted.id not in self.controls:
            raise Refused(errno.EINVAL)
        handle.subscribed[wanted.id] = wanted.flags
        if wanted.flags & _EVENT_SEND_INITIAL:
            self._post(handle, wanted.id, _EVENT_VALUE | _EVENT_FLAGS)

    def _unsubscribe(self, handle: Handle, body: bytearray) -> None:
        unwanted = codec.EventSubscription.from_buffer_copy(body)
        if unwanted.type == _EVENT_ALL:
            handle.subscribed.clear()
            handle.events.clear()
        else:
            handle.subscribed.pop(unwanted.id, None)

    def _dequeue_event(self, handle: Handle, body: bytearray) -> None:
        if not handle.events:
            raise Refused(errno.ENOENT)
        event = handle.events.popleft()
        event.pending = len(handle.events)
        body[:] = bytes(event)

    def _notify_others(self, setter: Handle, identity: int, changes: int) -> None:
        for handle in self.handles:
            flags = handle.subscribed.get(identity)
            if flags is not None and (handle is not setter or flags & _EVENT_ALLOW_FEEDBACK):
                self._post(handle, identity, changes)

    def _post(self, handle: Handle, identity: int, changes: int) -> None:
        control, now_ns = self.controls[identity], emulated_clock().now_ns()
        handle.events.append(
            codec.Event(
                type=_EVENT_CONTROL,
                changes=changes,
                ctrl_type=control.kind,
                value64=control.value,
                flags=self._flags(identity),
                minimum=control.minimum,
                maximum=control.maximum,
                step=control.step,
                default_value=control.default,
                sequence=handle.event_count,
                seconds=now_ns // 1_000_000_000,
                nanoseconds=now_ns % 1_000_000_000,
                id=identity,
            )
        )
        handle.event_count += 1


def _fresh(layout: type[S], body: bytearray, *kept: str) -> S:
    # The kernel zeroes every field that a driver does not fill, so only ``kept`` fields of the caller may survive.
    request_body = layout.from_buffer_copy(body)
    body[:] = bytes(ctypes.sizeof(layout))
    reply = layout.from_buffer(body)
    for name in kept:
        setattr(reply, name, getattr(request_body, name))
    return reply


def _nearest_format(body: bytearray) -> tuple[str, int, int]:
    pix = codec.Format.from_buffer_copy(body).pix
    request_body = codec.fourcc_text(pix.pixelformat)
    width, height = min(SIZES, key=lambda size: abs(size[0] - pix.width) + abs(size[1] - pix.height))
    return request_body if request_body in FORMATS else "YUYV", width, height


def _low_word(item: codec.ExtendedControl) -> int:
    return ctypes.c_int32(item.value64 & 0xFFFFFFFF).value


_HANDLERS: dict[int, Callable[[CameraModel, Handle, bytearray], Any]] = {
    codec.QUERYCAP: CameraModel._query_capability,
    codec.ENUM_FMT: CameraModel._enum_formats,
    codec.ENUM_FRAMESIZES: CameraModel._enum_sizes,
    codec.ENUM_FRAMEINTERVALS: CameraModel._enum_intervals,
    codec.G_FMT: CameraModel._get_format,
    codec.TRY_FMT: CameraModel._try_format,
    codec.S_FMT: CameraModel._set_format,
    codec.G_PARM: CameraModel._get_parameters,
    codec.S_PARM: CameraModel._set_parameters,
    codec.ENUMINPUT: CameraModel._enum_input,
    codec.G_INPUT: CameraModel._get_input,
    codec.S_INPUT: CameraModel._set_input,
    codec.G_PRIORITY: CameraModel._get_priority,
    codec.S_PRIORITY: CameraModel._set_priority,
    codec.REQBUFS: CameraModel._request_buffers,
    codec.QUERYBUF: CameraModel._query_buffer,
    codec.QBUF: CameraModel._queue_buffer,
    codec.STREAMON: CameraModel._stream_on,
    codec.STREAMOFF: CameraModel._stream_off,
    codec.QUERYCTRL: CameraModel._query_control,
    codec.QUERY_EXT_CTRL: CameraModel._query_extended,
    codec.QUERYMENU: CameraModel._query_menu,
    codec.G_CTRL: CameraModel._get_control,
    codec.S_CTRL: CameraModel._set_control,
    codec.G_EXT_CTRLS: CameraModel._get_extended,
    codec.TRY_EXT_CTRLS: CameraModel._try_extended,
    codec.S_EXT_CTRLS: CameraModel._set_extended,
    codec.SUBSCRIBE_EVENT: CameraModel._subscribe,
    codec.UNSUBSCRIBE_EVENT: CameraModel._unsubscribe,
    codec.DQEVENT: CameraModel._dequeue_event,
}
_NAMES = {request: handler.__name__.lstrip("_") for request, handler in _HANDLERS.items()}
