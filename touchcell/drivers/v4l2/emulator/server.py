"""An emulated TacTip camera: a process behind sockets that ``v4l2_shim.c`` turns into /dev/videoN.

    touchcell emulate v4l2 --folder /tmp/cameras

prints the two environment variables that make the camera visible to any program.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import errno
import math
import mmap
import os
import socket
import struct
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.v4l2 import codec
from touchcell.drivers.v4l2.emulator import picture
from touchcell.drivers.v4l2.emulator.device import SLOT_BYTES, CameraModel, Handle
from touchcell.drivers.v4l2.shim import environment
from touchcell.geometry.types import ImageArray
from touchcell.testing.emulation.base import Emulator

_MAX_MESSAGE = 8192
_LATE_PERIODS = 10
_PACKET_BYTES = 512
_OLDER_FRAMES = 100
_FOREIGN_CLOCK_NS = 1_000_000_000_000
# As reported of a first frame (raspberrypi/linux 1984): 131 years.
_WILD_STAMP_NS = 4_154_505_010_207_436_000
_EXPOSURE_FOR_FULL_LIGHT = 157
_GAIN_FOR_DOUBLE_LIGHT = 50
_LIGHT_STEP = 0.01
_DARKNESS = 0.05


class _Client:
    """One open file handle of the camera: its requests, its filled buffers, its memory."""

    def __init__(self, control: socket.socket, minor: int) -> None:
        self.control = control
        self.handle = Handle()
        self.frames, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.frames.setblocking(False)
        descriptor = os.memfd_create("touchcell-v4l2", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, SLOT_BYTES * codec.MAX_BUFFERS)
        self.memory = mmap.mmap(descriptor, SLOT_BYTES * codec.MAX_BUFFERS)
        socket.send_fds(control, [struct.pack("=iI", 0, minor)], [theirs.fileno(), descriptor])
        theirs.close()
        os.close(descriptor)

    def close(self) -> None:
        """Close the connection: the program sees an unplugged camera."""
        self.control.close()
        self.frames.close()
        self.memory.close()


class V4l2Emulator(Emulator):
    """Emulator of one camera.

    Args:
        folder: folder of its sockets and its sysfs entry.
        minor: number N of its /dev/videoN.
        images: folder of images to show instead of the synthetic ones.
        show: function from a frame's number to the grey image (height, width) to show; replaces both.
        latency_s: time from a frame's exposure to its delivery.
    """

    faults: ClassVar = {
        "pause": "the sensor hangs: no frames, requests are still answered",
        "drop": "number of frames lost in transport; the sequence number continues",
        "delay": "seconds by which frames arrive late, with their true timestamps",
        "freeze_frame": "the same image for ever, with fresh timestamps and numbers",
        "corrupt": "number of truncated frames",
        "error_flag": "number of frames that the kernel marks as corrupt",
        "gain": "factor on the brightness, as of a lamp that fails",
        "exposure_drift": "change of brightness per second, as a fraction",
        "stuck_controls": "controls accept every value and change nothing",
        "no_monotonic": "timestamps on an unknown clock",
        "out_of_order": "number of frames with the number and timestamp of 100 frames ago",
        "unplug": "the camera is disconnected until this is cleared",
        "padding": "number of frames with bytes after the end of the picture that are not zero",
        "hole": "number of frames that miss a packet in the middle and still have an end",
        "true_rate": "frames per second that are really made, numbered without gaps",
        "no_s_parm": "the camera has one fixed frame rate and no setting for it",
        "no_bandwidth": "the USB bus has no room: streaming cannot start",
        "forgets": "every control returns to its default when the stream starts",
        "reset_controls": "every control returns to its default now",
        "unreadable": "number of times that a frame cannot be dequeued (EIO)",
        "empty": "number of frames without any bytes",
        "busy": "another program streams from the camera",
        "metadata_node": "the name is that of the camera's second node, for metadata",
        "only_format": "[pixel format, width, height]: the camera has no other and substitutes it silently",
        "granted_rate": "frame rate that the camera grants, and makes, whatever is asked for",
        "control_errors": "requests for controls fail with this error number",
        "slow_start": "seconds until the first frame of a stream",
        "dark": "the light is off",
        "stamp_shift": "seconds added to every stamp, as by a driver that computes it wrongly",
        "wild_stamps": "number of frames with a stamp far from any time",
        "stuck_stamp": "every frame has the stamp of the one before this began",
        "stuck_number": "every frame has the number 0",
        "duplicates": "number of frames that are delivered twice",
        "other_camera": "another camera of the same make, at another socket, has this name",
        "restart": "seconds for which the camera is disconnected before it returns by itself",
    }

    def __init__(
        self,
        folder: Path,
        minor: int = 0,
        images: Path | None = None,
        show: Callable[[int], ImageArray] | None = None,
        latency_s: float = 0.0,
    ) -> None:
        super().__init__()
        self._latency_s = latency_s
        self._show = show
        self._folder = folder
        self._minor = minor
        self._files: Sequence[Path] = picture.files(images) if images else ()
        self.model = CameraModel("TacTip emulated", self._bus, self._on_stream)
        self._clients: dict[Handle, _Client] = {}
        self._listener: socket.socket | None = None
        self._stream: asyncio.Task[None] | None = None
        self._sequence = -1
        self._shown: bytes = b""
        self._counts = {"delivered": 0, "dropped": 0, "overruns": 0}
        self._last_stamp_ns = 0
        self._drift_since_s = 0.0

    @property
    def _bus(self) -> str:
        return f"usb-0000:00:14.0-{self._minor + 1}"

    @property
    def name(self) -> str:
        """Name of its node under /dev."""
        return f"video{self._minor}"

    @property
    def stable_name(self) -> str:
        """Name of its link under /dev/v4l/by-id."""
        return f"usb-TacTip_{self._minor:04d}-video-index0"

    async def start(self) -> None:
        """Open the camera's socket and write its sysfs entry."""
        entry = self._folder / "sys" / f"81:{self._minor}"
        entry.mkdir(parents=True, exist_ok=True)
        (entry / "uevent").write_text(f"MAJOR=81\nMINOR={self._minor}\nDEVNAME={self.name}\n")
        self._plug()

    async def stop(self) -> None:
        """Unplug the camera and close its socket."""
        self._unplug()

    def state(self) -> dict[str, Any]:
        """Return format, controls, counters, and whether it is plugged in."""
        model = self.model
        return {
            "plugged": self._listener is not None,
            "streaming": model.streaming,
            "clients": len(self._clients),
            "pixel_format": model.pixel_format,
            "size": [model.width, model.height],
            "rate_hz": model.rate_hz,
            "controls": {control.name: control.value for control in model.controls.values() if control.step},
            "sequence": self._sequence,
            "queued": len(model.queued),
            "buffers": model.buffers,
            **self._counts,
            "last_stamp_ns": self._last_stamp_ns,
            "requests": dict(model.requests),
            "settings_changed": model.settings_changed,
            "energising": model.energising,
            "faults": sorted(self.active),
            "energised": False,
            "watchdog": None,
            "last_command_ns": model.last_command_ns,
        }

    def on_fault(self, fault: str, value: Any) -> None:
        if fault in ("unplug", "restart"):
            self._unplug()
        if fault == "restart":
            asyncio.get_running_loop().call_later(float(value), self.end, "restart")
        if fault == "exposure_drift":
            self._drift_since_s = 1e-9 * emulated_clock().now_ns()
        if fault == "no_monotonic":
            self.model.stamp_flags &= ~codec.BUF_TIMESTAMP_MASK
        if fault == "reset_controls":
            self.model.reset_controls()
            del self.active[fault]
        self._adapt_model()

    def _adapt_model(self) -> None:
        model, active = self.model, self.active
        model.stuck_controls = "stuck_controls" in active
        model.forgetful = "forgets" in active
        model.fixed_rate = "no_s_parm" in active
        model.no_bandwidth = "no_bandwidth" in active
        model.only_format = tuple(active["only_format"]) if "only_format" in active else None
        model.granted_rate_hz = float(active["granted_rate"]) if "granted_rate" in active else None
        model.control_error = int(active.get("control_errors", 0))
        model.busy = "busy" in active
        model.is_metadata = "metadata_node" in active
        model.bus = f"{self._bus}.4" if "other_camera" in active else self._bus

    def on_clear(self, fault: str) -> None:
        if fault in ("unplug", "restart") and self._listener is None:
            self._plug()
        if fault == "no_monotonic":
            self.model.stamp_flags |= codec.BUF_TIMESTAMP_MONOTONIC
        self._adapt_model()

    def _plug(self) -> None:
        # The path of a socket is limited to 107 characters; that of the folder is not.
        folder = os.open(self._folder, os.O_PATH | os.O_DIRECTORY)
        try:
            self._remove_names()
            self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self._listener.bind(f"/proc/self/fd/{folder}/{self.name}.sock")
        finally:
            os.close(folder)
        (self._folder / f"{self.stable_name}.sock").symlink_to(f"{self.name}.sock")
        self._listener.listen(16)
        self._listener.setblocking(False)
        asyncio.get_running_loop().add_reader(self._listener, self._accept)

    def _unplug(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None
        self._remove_names()
        for client in list(self._clients.values()):
            self._hang_up(client)

    def _remove_names(self) -> None:
        for name in (self.name, self.stable_name):
            (self._folder / f"{name}.sock").unlink(missing_ok=True)

    def _accept(self) -> None:
        assert self._listener is not None
        control, _ = self._listener.accept()
        client = _Client(control, self._minor)
        self._clients[client.handle] = client
        self.model.handles.add(client.handle)
        asyncio.get_running_loop().add_reader(control, self._serve, client)

    def _serve(self, client: _Client) -> None:
        try:
            message = client.control.recv(_MAX_MESSAGE)
        except ConnectionError:
            message = b""
        if len(message) < 8:
            self._hang_up(client)
            return
        tag, request = struct.unpack_from("=II", message)
        body = bytearray(message[8:])
        error = self.model.answer(client.handle, request, body)
        if request != codec.QBUF:
            with contextlib.suppress(OSError):
                client.control.send(struct.pack("=II", tag, error) + body)

    def _hang_up(self, client: _Client) -> None:
        asyncio.get_running_loop().remove_reader(client.control)
        del self._clients[client.handle]
        self.model.release(client.handle)
        client.close()

    def _on_stream(self, begins: bool) -> None:
        if self._stream is not None:
            self._stream.cancel()
            self._stream = None
            self._wake_waiting()
        if begins:
            self._sequence = -1
            self._shown = b""
            self._stream = asyncio.create_task(self._run_sensor())

    def _wake_waiting(self) -> None:
        # A thread that blocks in DQBUF must return when another thread stops the stream.
        if self.model.owner in self._clients:
            with contextlib.suppress(OSError):
                self._clients[self.model.owner].frames.send(b"\0")

    async def _run_sensor(self) -> None:
        loop = asyncio.get_running_loop()
        next_s = loop.time() + float(self.active.get("slow_start", 0.0))
        while True:
            made_hz = self.model.granted_rate_hz or self.model.rate_hz
            period_s = max(1.0 / float(self.active.get("true_rate", made_hz)), self.model.exposure_s)
            next_s += period_s
            if loop.time() - next_s > _LATE_PERIODS * period_s:
                next_s = loop.time()
            await asyncio.sleep(next_s - loop.time())
            if "pause" not in self.active:
                self._expose()

    def _expose(self) -> None:
        stamp_ns = emulated_clock().now_ns()
        self._sequence += 1
        if self.spend("drop"):
            self._counts["dropped"] += 1
            return
        data, flags, sequence = self._picture(), 0, self._sequence
        if self.spend("corrupt"):
            data = data[: len(data) // 2]
        if self.spend("empty"):
            data = b""
        if self.spend("unreadable"):
            self._fail_dequeue(errno.EIO)
        if self.spend("padding"):
            data += b"\x13\xff\xd8\x07" * 8
        if self.spend("hole"):
            data = data[: len(data) // 2] + data[len(data) // 2 + _PACKET_BYTES :]
        if self.spend("error_flag"):
            flags |= codec.BUF_ERROR
        if self.spend("out_of_order"):
            sequence -= _OLDER_FRAMES
            stamp_ns -= _OLDER_FRAMES * round(1e9 / self.model.rate_hz)
        if "no_monotonic" in self.active:
            stamp_ns += _FOREIGN_CLOCK_NS
        stamp_ns += round(1e9 * float(self.active.get("stamp_shift", 0.0)))
        if "stuck_stamp" in self.active:
            stamp_ns = self._last_stamp_ns
        if "stuck_number" in self.active:
            sequence = 0
        if self.spend("wild_stamps"):
            stamp_ns = _WILD_STAMP_NS
        stream, delay_s = self._stream, self._latency_s + float(self.active.get("delay", 0.0))
        for _ in range(2 if self.spend("duplicates") else 1):
            if delay_s > 0.0:
                asyncio.get_running_loop().call_later(delay_s, self._deliver, stream, data, sequence, stamp_ns, flags)
            else:
                self._deliver(stream, data, sequence, stamp_ns, flags)

    def _deliver(
        self, stream: asyncio.Task[None] | None, data: bytes, sequence: int, stamp_ns: int, flags: int
    ) -> None:
        owner = self.model.owner
        if owner is None or stream is not self._stream:
            return
        index = self.model.next_buffer()
        if index is None:
            self._counts["overruns"] += 1
            return
        client = self._clients[owner]
        client.memory[index * SLOT_BYTES : index * SLOT_BYTES + len(data)] = data
        with contextlib.suppress(OSError):
            client.frames.send(bytes(self.model.filled(index, len(data), sequence, stamp_ns, flags)))
        self._counts["delivered"] += 1
        self._last_stamp_ns = stamp_ns

    def _fail_dequeue(self, error: int) -> None:
        if self.model.owner in self._clients:
            with contextlib.suppress(OSError):
                self._clients[self.model.owner].frames.send(struct.pack("=2i", 0, error))

    def _picture(self) -> bytes:
        if "freeze_frame" in self.active and self._shown:
            return self._shown
        model = self.model
        if self._show is not None:
            seen = picture.brightened(self._show(self._sequence), self._light())
            self._shown = picture.encoded(picture.resized(seen, model.width, model.height), model.pixel_format)
            return self._shown
        number = self._sequence % (len(self._files) or picture.PICTURES)
        self._shown = _frame(
            self._files[number] if self._files else number,
            model.width,
            model.height,
            model.pixel_format,
            round(self._light() / _LIGHT_STEP),
        )
        return self._shown

    def _light(self) -> float:
        controls = self.model.controls
        light = 1.0 + controls[codec.CID_GAIN].value / _GAIN_FOR_DOUBLE_LIGHT
        if controls[codec.CID_EXPOSURE_AUTO].value == codec.EXPOSURE_MANUAL:
            light *= math.sqrt(controls[codec.CID_EXPOSURE_ABSOLUTE].value / _EXPOSURE_FOR_FULL_LIGHT)
        if "dark" in self.active:
            light *= _DARKNESS
        light *= float(self.active.get("gain", 1.0))
        drift_per_s = float(self.active.get("exposure_drift", 0.0))
        return light * max(0.0, 1.0 + drift_per_s * (1e-9 * emulated_clock().now_ns() - self._drift_since_s))


@lru_cache(maxsize=96)
def _frame(source: Path | int, width: int, height: int, pixel_format: str, light: int) -> bytes:
    if isinstance(source, Path):
        image = picture.from_file(source, width, height)
    else:
        image = picture.synthetic(source, width, height)
    return picture.encoded(picture.brightened(image, light * _LIGHT_STEP), pixel_format)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments."""
    parser.add_argument("--folder", type=Path, required=True, help="folder for the camera's sockets")
    parser.add_argument("--minor", type=int, default=0, help="N of /dev/videoN")
    parser.add_argument("--images", type=Path, help="folder of images to show in turn")


def build(arguments: argparse.Namespace) -> Emulator:
    """Build the emulator, not yet started, and print how a program sees it."""
    print(
        " ".join(f"{key}={value}" for key, value in environment(arguments.folder).items()), "PROGRAM", file=sys.stderr
    )
    return V4l2Emulator(arguments.folder, arguments.minor, arguments.images)
