"""Video4Linux2 ABI: request numbers, structures and checks of captured frames. Pure functions, no I/O.

Layouts are those of 64-bit Linux. Source: the kernel's userspace interface documentation, "Video for Linux API"
(https://www.kernel.org/doc/html/latest/userspace-api/media/v4l/), and for request numbers "ioctl numbers"
(direction in bits 30-31, size in bits 16-29, type 'V' in bits 8-15, number in bits 0-7).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TypeAlias

from touchcell.drivers.v4l2 import jpeg

U8, U32, S32, U64, S64 = ctypes.c_uint8, ctypes.c_uint32, ctypes.c_int32, ctypes.c_uint64, ctypes.c_int64

VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1
MAX_BUFFERS = 32

CAP_VIDEO_CAPTURE = 0x00000001
CAP_EXT_PIX_FORMAT = 0x00200000
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000
CAP_TIMEPERFRAME = 0x1000

BUF_MAPPED = 0x1
BUF_QUEUED = 0x2
BUF_DONE = 0x4
BUF_ERROR = 0x40
BUF_TIMESTAMP_MASK = 0xE000
BUF_TIMESTAMP_MONOTONIC = 0x2000
BUF_STAMP_SOURCE_MASK = 0x70000
BUF_STAMP_START_OF_EXPOSURE = 0x10000

CTRL_DISABLED = 0x1
CTRL_GRABBED = 0x2
CTRL_READ_ONLY = 0x4
CTRL_UPDATE = 0x8
CTRL_INACTIVE = 0x10
CTRL_NEXT = 0x80000000
CTRL_NEXT_COMPOUND = 0x40000000

CID_AUTO_WHITE_BALANCE = 0x0098090C
CID_GAIN = 0x00980913
CID_AUTOGAIN = 0x00980912
CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902
CID_EXPOSURE_AUTO_PRIORITY = 0x009A0903
EXPOSURE_MANUAL = 1
EXPOSURE_UNIT_US = 100
"""Nanoseconds per unit of V4L2_CID_EXPOSURE_ABSOLUTE (100 microseconds)."""


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", U32),
        ("capabilities", U32),
        ("device_caps", U32),
        ("reserved", U32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = (
        ("index", U32),
        ("type", U32),
        ("flags", U32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", U32),
        ("mbus_code", U32),
        ("reserved", U32 * 3),
    )


class PixelFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        ("width", U32),
        ("height", U32),
        ("pixelformat", U32),
        ("field", U32),
        ("bytesperline", U32),
        ("sizeimage", U32),
        ("colorspace", U32),
        ("priv", U32),
        ("flags", U32),
        ("ycbcr_enc", U32),
        ("quantization", U32),
        ("xfer_func", U32),
    )


class Format(ctypes.Structure):
    """struct v4l2_format with its single-planar pixel format; the union is 8-byte aligned because of its pointers."""

    _fields_ = (("type", U32), ("_hole", U32), ("pix", PixelFormat), ("_union", U8 * (200 - 48)))


class Fraction(ctypes.Structure):
    """struct v4l2_fract, seconds per frame."""

    _fields_ = (("numerator", U32), ("denominator", U32))


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with its capture parameters."""

    _fields_ = (
        ("type", U32),
        ("capability", U32),
        ("capturemode", U32),
        ("timeperframe", Fraction),
        ("extendedmode", U32),
        ("readbuffers", U32),
        ("reserved", U32 * 4),
        ("_union", U8 * (200 - 40)),
    )


class FrameSize(ctypes.Structure):
    """struct v4l2_frmsizeenum for discrete sizes."""

    _fields_ = (
        ("index", U32),
        ("pixel_format", U32),
        ("type", U32),
        ("width", U32),
        ("height", U32),
        ("_union", U32 * 4),
        ("reserved", U32 * 2),
    )


class FrameInterval(ctypes.Structure):
    """struct v4l2_frmivalenum for discrete intervals."""

    _fields_ = (
        ("index", U32),
        ("pixel_format", U32),
        ("width", U32),
        ("height", U32),
        ("type", U32),
        ("discrete", Fraction),
        ("_union", U32 * 4),
        ("reserved", U32 * 2),
    )


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        ("count", U32),
        ("type", U32),
        ("memory", U32),
        ("capabilities", U32),
        ("flags", U8),
        ("reserved", U8 * 3),
    )


class Buffer(ctypes.Structure):
    """struct v4l2_buffer; ``offset`` is the memory-mapped member of its union."""

    _fields_ = (
        ("index", U32),
        ("type", U32),
        ("bytesused", U32),
        ("flags", U32),
        ("field", U32),
        ("_hole", U32),
        ("seconds", S64),
        ("microseconds", S64),
        ("timecode", U8 * 16),
        ("sequence", U32),
        ("memory", U32),
        ("offset", U64),
        ("length", U32),
        ("reserved2", U32),
        ("request_fd", S32),
        ("_tail", U32),
    )


class Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", U32), ("value", S32))


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _fields_ = (
        ("id", U32),
        ("type", U32),
        ("name", ctypes.c_char * 32),
        ("minimum", S32),
        ("maximum", S32),
        ("step", S32),
        ("default_value", S32),
        ("flags", U32),
        ("reserved", U32 * 2),
    )


class QueryExtendedControl(ctypes.Structure):
    """struct v4l2_query_ext_ctrl."""

    _fields_ = (
        ("id", U32),
        ("type", U32),
        ("name", ctypes.c_char * 32),
        ("minimum", S64),
        ("maximum", S64),
        ("step", U64),
        ("default_value", S64),
        ("flags", U32),
        ("elem_size", U32),
        ("elems", U32),
        ("nr_of_dims", U32),
        ("dims", U32 * 4),
        ("reserved", U32 * 32),
    )


class QueryMenu(ctypes.Structure):
    """struct v4l2_querymenu."""

    _pack_ = 1
    _fields_ = (("id", U32), ("index", U32), ("name", ctypes.c_char * 32), ("reserved", U32))


class ExtendedControl(ctypes.Structure):
    """struct v4l2_ext_control."""

    _pack_ = 1
    _fields_ = (("id", U32), ("size", U32), ("reserved2", U32), ("value64", S64))


class ExtendedControls(ctypes.Structure):
    """struct v4l2_ext_controls; ``controls`` points to ``count`` ExtendedControl."""

    _fields_ = (
        ("which", U32),
        ("count", U32),
        ("error_idx", U32),
        ("request_fd", S32),
        ("reserved", U32),
        ("controls", U64),
    )


class Input(ctypes.Structure):
    """struct v4l2_input."""

    _fields_ = (
        ("index", U32),
        ("name", ctypes.c_char * 32),
        ("type", U32),
        ("audioset", U32),
        ("tuner", U32),
        ("std", U64),
        ("status", U32),
        ("capabilities", U32),
        ("reserved", U32 * 3),
    )


class EventSubscription(ctypes.Structure):
    """struct v4l2_event_subscription."""

    _fields_ = (("type", U32), ("id", U32), ("flags", U32), ("reserved", U32 * 5))


class Event(ctypes.Structure):
    """struct v4l2_event carrying a control's change (struct v4l2_event_ctrl)."""

    _fields_ = (
        ("type", U32),
        ("_hole", U32),
        ("changes", U32),
        ("ctrl_type", U32),
        ("value64", S64),
        ("flags", U32),
        ("minimum", S32),
        ("maximum", S32),
        ("step", S32),
        ("default_value", S32),
        ("_union", U8 * (64 - 36)),
        ("pending", U32),
        ("sequence", U32),
        ("seconds", S64),
        ("nanoseconds", S64),
        ("id", U32),
        ("reserved", U32 * 8),
    )


Layout: TypeAlias = type[ctypes.Structure] | type[ctypes.c_int32] | type[ctypes.c_uint32]
_READ, _WRITE = 2, 1


def _request(direction: int, number: int, layout: Layout) -> int:
    return direction << 30 | ctypes.sizeof(layout) << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITE, 2, FormatDescription)
G_FMT = _request(_READ | _WRITE, 4, Format)
S_FMT = _request(_READ | _WRITE, 5, Format)
REQBUFS = _request(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
QBUF = _request(_READ | _WRITE, 15, Buffer)
DQBUF = _request(_READ | _WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, S32)
STREAMOFF = _request(_WRITE, 19, S32)
G_PARM = _request(_READ | _WRITE, 21, StreamParameters)
S_PARM = _request(_READ | _WRITE, 22, StreamParameters)
ENUMINPUT = _request(_READ | _WRITE, 26, Input)
G_CTRL = _request(_READ | _WRITE, 27, Control)
S_CTRL = _request(_READ | _WRITE, 28, Control)
QUERYCTRL = _request(_READ | _WRITE, 36, QueryControl)
QUERYMENU = _request(_READ | _WRITE, 37, QueryMenu)
G_INPUT = _request(_READ, 38, S32)
S_INPUT = _request(_READ | _WRITE, 39, S32)
TRY_FMT = _request(_READ | _WRITE, 64, Format)
G_PRIORITY = _request(_READ, 67, U32)
S_PRIORITY = _request(_WRITE, 68, U32)
G_EXT_CTRLS = _request(_READ | _WRITE, 71, ExtendedControls)
S_EXT_CTRLS = _request(_READ | _WRITE, 72, ExtendedControls)
TRY_EXT_CTRLS = _request(_READ | _WRITE, 73, ExtendedControls)
ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, FrameSize)
ENUM_FRAMEINTERVALS = _request(_READ | _WRITE, 75, FrameInterval)
DQEVENT = _request(_READ, 89, Event)
SUBSCRIBE_EVENT = _request(_WRITE, 90, EventSubscription)
UNSUBSCRIBE_EVENT = _request(_WRITE, 91, EventSubscription)
QUERY_EXT_CTRL = _request(_READ | _WRITE, 103, QueryExtendedControl)


def fourcc(text: str) -> int:
    """Return the number of a four-character pixel format, e.g. "MJPG"."""
    return int.from_bytes(text.encode("ascii"), "little")


def fourcc_text(number: int) -> str:
    """Return the four characters of a pixel format number, with "?" for unprintable ones."""
    return "".join(chr(b) if 32 <= b < 127 else "?" for b in number.to_bytes(4, "little"))


@dataclass(frozen=True, slots=True)
class Arrival:
    """Metadata of one filled buffer from the kernel.

    Attributes:
        index: index of the buffer.
        bytes_used: bytes of the frame in it.
        sequence: 32-bit frame counter of the device; a gap means lost frames.
        stamp_ns: kernel timestamp, ns, on the clock given by ``monotonic``.
        monotonic: whether the timestamp is on CLOCK_MONOTONIC.
        start_of_exposure: whether it marks the start of exposure rather than the end of the frame.
        damaged: whether the kernel driver marks the data as corrupt (V4L2_BUF_FLAG_ERROR).
    """

    index: int
    bytes_used: int
    sequence: int
    stamp_ns: int
    monotonic: bool
    start_of_exposure: bool
    damaged: bool


def arrival(buffer: Buffer) -> Arrival:
    """Decode a buffer returned by DQBUF."""
    return Arrival(
        index=buffer.index,
        bytes_used=buffer.bytesused,
        sequence=buffer.sequence,
        stamp_ns=buffer.seconds * 1_000_000_000 + buffer.microseconds * 1000,
        monotonic=buffer.flags & BUF_TIMESTAMP_MASK == BUF_TIMESTAMP_MONOTONIC,
        start_of_exposure=buffer.flags & BUF_STAMP_SOURCE_MASK == BUF_STAMP_START_OF_EXPOSURE,
        damaged=bool(buffer.flags & BUF_ERROR),
    )


def sequence_step(before: int, now: int) -> int:
    """Return the signed difference of two 32-bit frame counters; the wrap at 2**32 is a step of one."""
    return (now - before + 2**31) % 2**32 - 2**31


def damage(data: bytes, pixel_format: str, width: int, height: int) -> str:
    """Return why ``data`` is not a complete frame, or "" if it looks complete.

    Raw formats can only be checked by their length.
    """
    if pixel_format == "MJPG":
        return jpeg.damage(data, width, height)
    whole = width * height * (2 if pixel_format == "YUYV" else 1)
    return "" if len(data) == whole else f"{len(data)} bytes instead of {whole}"
