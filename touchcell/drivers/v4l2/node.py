"""System calls on one open video node, with typed errors. No policy, no threads."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
import select
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from touchcell.drivers.core.errors import ConnectError, DeviceError, DeviceGone, TransportError
from touchcell.drivers.v4l2 import codec

_GONE = (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN)


class SystemCalls(Protocol):
    """System calls that a camera needs. Real cameras use ``KernelCalls``; an emulator may provide its own."""

    def now_ns(self) -> int:
        """Return the time of the clock that frames are stamped with."""
        ...

    def open(self, path: str) -> int:
        """Return a file descriptor, read-write and non-blocking."""
        ...

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int32) -> None:
        """Issue a control request, changing ``argument`` in place. Raises OSError."""
        ...

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Map a buffer into memory, shared."""
        ...

    def poll(self, fd: int, timeout_s: float) -> int:
        """Return the bits of poll(2) among POLLIN, POLLERR, POLLHUP; 0 after the timeout."""
        ...

    def close(self, fd: int) -> None:
        """Close the file descriptor."""
        ...


class KernelCalls:
    """System calls of the kernel."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def open(self, path: str) -> int:
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int32) -> None:
        fcntl.ioctl(fd, request, argument, True)

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def poll(self, fd: int, timeout_s: float) -> int:
        poller = select.poll()
        poller.register(fd, select.POLLIN)
        events = poller.poll(max(timeout_s, 0.0) * 1e3)
        return events[0][1] if events else 0

    def close(self, fd: int) -> None:
        os.close(fd)


@dataclass(frozen=True, slots=True)
class AppliedFormat:
    """Image format applied by a device.

    Attributes:
        pixel_format: four characters.
        width_px, height_px: size.
        bytes_per_line: row pitch of raw formats.
    """

    pixel_format: str
    width_px: int
    height_px: int
    bytes_per_line: int


class VideoNode:
    """An open capture node that streams into memory-mapped buffers.

    Args:
        device: name of the device in the cell, for errors.
        path: video node, or a link to it.
        calls: system calls.

    Raises:
        ConnectError: no such node, no permission, or not a streaming camera.
    """

    def __init__(self, device: str, path: str, calls: SystemCalls) -> None:
        self._device = device
        self._calls = calls
        self._buffers: list[mmap.mmap] = []
        try:
            self._fd = calls.open(path)
        except OSError as error:
            raise ConnectError(
                device, f"cannot open {path}: {error.strerror}", [error], hint=_open_hint(error, path)
            ) from None
        try:
            self._capability = self._query_capability(path)
            self._serial = _usb_serial(path)
        except BaseException:
            calls.close(self._fd)
            raise

    @property
    def card(self) -> str:
        """Product name reported by the device."""
        return bytes(self._capability.card).decode("utf-8", "replace")

    @property
    def bus(self) -> str:
        """Bus address reported by the kernel driver."""
        return bytes(self._capability.bus_info).decode("utf-8", "replace")

    @property
    def serial(self) -> str:
        """USB serial number, or "" if the device has none."""
        return self._serial

    def pixel_formats(self) -> list[str]:
        """Return the four-character names of supported formats. Raises TransportError, DeviceGone."""
        names: list[str] = []
        while True:
            description = codec.FormatDescription(index=len(names), type=codec.VIDEO_CAPTURE)
            try:
                self._calls.ioctl(self._fd, codec.ENUM_FMT, description)
            except OSError as error:
                if error.errno == errno.EINVAL:
                    return names
                raise self._error(error, "list the image formats") from None
            names.append(codec.fourcc_text(description.pixelformat))

    def set_format(self, pixel_format: str, width_px: int, height_px: int) -> AppliedFormat:
        """Request a format and return the one that the device chose. Raises TransportError, DeviceGone."""
        request = codec.Format(type=codec.VIDEO_CAPTURE)
        request.pix.width, request.pix.height = width_px, height_px
        request.pix.pixelformat, request.pix.field = codec.fourcc(pixel_format), codec.FIELD_NONE
        self._ask(codec.S_FMT, request, "set the image format")
        pix = request.pix
        return AppliedFormat(codec.fourcc_text(pix.pixelformat), pix.width, pix.height, pix.bytesperline)

    def try_format(self, pixel_format: str, width_px: int, height_px: int) -> AppliedFormat:
        """Return the format that the device would choose for a request; nothing changes. Raises as ``set_format``."""
        request = codec.Format(type=codec.VIDEO_CAPTURE)
        request.pix.width, request.pix.height = width_px, height_px
        request.pix.pixelformat, request.pix.field = codec.fourcc(pixel_format), codec.FIELD_NONE
        self._ask(codec.TRY_FMT, request, "try the image format")
        pix = request.pix
        return AppliedFormat(codec.fourcc_text(pix.pixelformat), pix.width, pix.height, pix.bytesperline)

    def is_busy(self) -> bool:
        """Return whether another program holds its buffers; asked by freeing our own, of which there are none."""
        none = codec.RequestBuffers(type=codec.VIDEO_CAPTURE, memory=codec.MEMORY_MMAP)
        try:
            self._calls.ioctl(self._fd, codec.REQBUFS, none)
        except OSError as error:
            return error.errno == errno.EBUSY
        return False

    def set_rate(self, rate_hz: float) -> float | None:
        """Request a frame rate and return the one that the device chose, Hz; None if it has no such setting.

        Raises:
            TransportError, DeviceGone: the device failed.
        """
        request = codec.StreamParameters(type=codec.VIDEO_CAPTURE)
        request.timeperframe = codec.Fraction(1000, round(rate_hz * 1000))
        try:
            self._calls.ioctl(self._fd, codec.S_PARM, request)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                return None
            raise self._error(error, "set the frame rate") from None
        period = request.timeperframe
        if not request.capability & codec.CAP_TIMEPERFRAME:
            return None
        return period.denominator / period.numerator if period.numerator else 0.0

    def has_control(self, identity: int) -> bool:
        """Return whether the device has a usable control of that number. Raises TransportError, DeviceGone."""
        query = codec.QueryControl(id=identity)
        try:
            self._calls.ioctl(self._fd, codec.QUERYCTRL, query)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return False
            raise self._error(error, "query a control") from None
        return not query.flags & codec.CTRL_DISABLED

    def control(self, identity: int) -> int | None:
        """Return the present value of a control, or None if the device does not report it. Raises DeviceGone."""
        request = codec.Control(id=identity)
        try:
            self._calls.ioctl(self._fd, codec.G_CTRL, request)
        except OSError as error:
            # A stalled control request (EPIPE), a transfer error, or whatever else the camera's firmware answers.
            if error.errno in _GONE:
                raise self._error(error, "read a control") from None
            return None
        return int(request.value)

    def set_control(self, identity: int, value: int) -> int | None:
        """Set a control and return the value read back, None if it cannot be read; the device may refuse silently.

        Raises:
            DeviceGone: the device is disconnected.
        """
        try:
            self._calls.ioctl(self._fd, codec.S_CTRL, codec.Control(id=identity, value=value))
        except OSError as error:
            if error.errno in _GONE:
                raise self._error(error, "set a control") from None
        return self.control(identity)

    def start(self, buffers: int) -> int:
        """Map and queue buffers and start streaming; return the number of buffers that the device granted.

        Raises:
            ConnectError: another program streams from it.
            TransportError, DeviceGone: the device failed.
        """
        request = codec.RequestBuffers(count=buffers, type=codec.VIDEO_CAPTURE, memory=codec.MEMORY_MMAP)
        self._ask(codec.REQBUFS, request, "request buffers")
        for index in range(request.count):
            buffer = codec.Buffer(index=index, type=codec.VIDEO_CAPTURE, memory=codec.MEMORY_MMAP)
            self._ask(codec.QUERYBUF, buffer, "query a buffer")
            self._buffers.append(self._calls.map(self._fd, buffer.length, buffer.offset))
            self.give_back(index)
        self._ask(codec.STREAMON, ctypes.c_int32(codec.VIDEO_CAPTURE), "start streaming")
        return int(request.count)

    def wait(self, timeout_s: float) -> bool:
        """Wait up to ``timeout_s`` for a frame; return whether one is available. Raises DeviceGone."""
        bits = self._calls.poll(self._fd, timeout_s)
        if bits & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
            raise DeviceGone(self._device, "the camera is disconnected", hint="plug it in and recover")
        return bool(bits & select.POLLIN)

    def take(self) -> codec.Arrival | None:
        """Dequeue the next filled buffer, or None if none is waiting. Raises TransportError, DeviceGone."""
        buffer = codec.Buffer(type=codec.VIDEO_CAPTURE, memory=codec.MEMORY_MMAP)
        try:
            self._calls.ioctl(self._fd, codec.DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise self._error(error, "dequeue a frame") from None
        if buffer.index >= len(self._buffers) or buffer.bytesused > len(self._buffers[buffer.index]):
            raise TransportError(self._device, f"{buffer.bytesused} bytes in buffer {buffer.index} are impossible")
        return codec.arrival(buffer)

    def data(self, arrival: codec.Arrival) -> bytes:
        """Copy the bytes of a dequeued frame; valid only until the buffer is queued again."""
        return self._buffers[arrival.index][: arrival.bytes_used]

    def give_back(self, index: int) -> None:
        """Queue a buffer for the next frame. Raises TransportError, DeviceGone."""
        buffer = codec.Buffer(index=index, type=codec.VIDEO_CAPTURE, memory=codec.MEMORY_MMAP)
        self._ask(codec.QBUF, buffer, "queue a buffer")

    def stop(self) -> None:
        """Stop streaming and free the buffers; never raises, as a disconnected camera has stopped."""
        for buffer in self._buffers:
            buffer.close()
        self._buffers.clear()
        none = codec.RequestBuffers(type=codec.VIDEO_CAPTURE, memory=codec.MEMORY_MMAP)
        with suppress(OSError):
            self._calls.ioctl(self._fd, codec.STREAMOFF, ctypes.c_int32(codec.VIDEO_CAPTURE))
            self._calls.ioctl(self._fd, codec.REQBUFS, none)

    def close(self) -> None:
        """Stop and close; never raises."""
        self.stop()
        self._calls.close(self._fd)

    def _query_capability(self, path: str) -> codec.Capability:
        capability = codec.Capability()
        try:
            self._calls.ioctl(self._fd, codec.QUERYCAP, capability)
        except OSError as error:
            raise ConnectError(self._device, f"{path} is not a video device: {error.strerror}", [error]) from None
        able = capability.device_caps if capability.capabilities & codec.CAP_DEVICE_CAPS else capability.capabilities
        missing = [
            word
            for word, bit in (("video capture", codec.CAP_VIDEO_CAPTURE), ("streaming", codec.CAP_STREAMING))
            if not able & bit
        ]
        if missing:
            raise ConnectError(
                self._device,
                f"{path} has no {' and no '.join(missing)}",
                hint="many cameras have a second node for metadata; use the one whose by-id name ends in index0",
            )
        return capability

    def _ask(self, request: int, argument: ctypes.Structure | ctypes.c_int32, what: str) -> None:
        try:
            self._calls.ioctl(self._fd, request, argument)
        except OSError as error:
            raise self._error(error, what) from None

    def _error(self, error: OSError, what: str) -> DeviceError:
        if error.errno in _GONE:
            return DeviceGone(
                self._device, f"the camera is disconnected (cannot {what})", hint="plug it in and recover"
            )
        if error.errno == errno.EBUSY:
            return ConnectError(self._device, f"cannot {what}: busy", [error], hint="close the program that uses it")
        if error.errno == errno.ENOSPC:
            return ConnectError(
                self._device,
                f"cannot {what}: the USB bus has no bandwidth left for it",
                [error],
                hint="plug the cameras into different USB controllers (`lsusb -t`), or use MJPG, a smaller picture or "
                "a lower rate",
            )
        if error.errno == errno.ENOMEM:
            return ConnectError(self._device, f"cannot {what}: the kernel has no memory for it", [error])
        return TransportError(self._device, f"cannot {what}: {error.strerror}")


def _usb_serial(path: str) -> str:
    name = os.path.basename(os.path.realpath(path))
    try:
        with open(f"/sys/class/video4linux/{name}/device/../serial", encoding="utf-8", errors="replace") as file:
            return file.read().strip()
    except OSError:
        return ""


def _open_hint(error: OSError, path: str) -> str:
    if error.errno == errno.EACCES:
        return "add yourself to the group that owns the node, usually video: sudo usermod -aG video $USER"
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"plug it in; `touchcell devices` lists cameras ({_neighbours(path)})"
    return ""


def _neighbours(path: str) -> str:
    folder = os.path.dirname(path) or "."
    try:
        names: Sequence[str] = sorted(name for name in os.listdir(folder) if "video" in name)
    except OSError:
        names = ()
    return f"in {folder}: {', '.join(names) or 'none'}"
