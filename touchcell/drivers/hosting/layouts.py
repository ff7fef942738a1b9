"""Layouts of the shared memory blocks: one structured dtype each, some followed by text or an image."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from enum import IntEnum
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from touchcell.drivers.hosting.memory import BlockReader, BlockWriter, create

VERSION: Final = 1

MAX_IMAGE_BYTES: Final = 1920 * 1080 * 3
"""Largest image that a frame block holds; unused pages take no memory."""

MAX_JOINTS: Final = 16

MAX_NOTE_BYTES: Final = 2048
"""Longest JSON text after a record."""


class Reason(IntEnum):
    """Reason of a stop of all arms."""

    NONE = 0
    TASK_SILENT = 1
    TASK_SLOW = 2
    HOST_SILENT = 3
    HOST_LATCHED = 4
    WATCHDOG_SILENT = 5
    TASK_GONE = 6
    HOST_GONE = 7

    @property
    def description(self) -> str:
        """Description for operators."""
        return _DESCRIPTIONS[self]


_DESCRIPTIONS: Final = {
    Reason.NONE: "nothing",
    Reason.TASK_SILENT: "the task's loop has missed two heartbeats",
    Reason.TASK_SLOW: "the task's loop is too slow",
    Reason.HOST_SILENT: "a device host has missed two heartbeats",
    Reason.HOST_LATCHED: "a device host has stopped its arms by itself",
    Reason.WATCHDOG_SILENT: "the watchdog has missed two heartbeats",
    Reason.TASK_GONE: "the task's process has ended",
    Reason.HOST_GONE: "the process of a device host has ended",
}


@dataclass(frozen=True, slots=True)
class Cause:
    """Cause of a stop of all arms.

    Attributes:
        reason: kind of cause.
        t_ns: time of detection.
        value_s, limit_s: measured time and its limit.
        host: number of the host concerned, -1 for none.
    """

    reason: Reason
    t_ns: int
    value_s: float = 0.0
    limit_s: float = 0.0
    host: int = -1


_CAUSE = [("reason", "u4"), ("host", "i4"), ("t_ns", "i8"), ("value_s", "f8"), ("limit_s", "f8")]
_BEAT = [("count", "u8"), ("t_ns", "i8")]

TASK: Final = np.dtype(
    [
        *_BEAT,
        ("guard", "u8"),
        ("late", "u8"),  # number of late periods, and duration of the newest of them
        ("late_ns", "i8"),
    ]
)
WATCH: Final = np.dtype([*_BEAT, ("guarding", "u8"), ("stop", "u8"), ("cause", _CAUSE)])
HOST: Final = np.dtype([*_BEAT, ("latched", "u8"), ("cause", _CAUSE)])
COMMAND: Final = np.dtype(
    [
        ("stop", "u8"),  # number of the newest stop; an older twist is dropped
        ("category", "u8"),
        ("number", "u8"),  # of the newest twist
        ("lease", "u8"),
        ("twist", "f8", (6,)),
        ("tcp_frame", "u8"),
        ("t_ns", "i8"),
        ("ttl_s", "f8"),
        ("has_cause", "u8"),
        ("t_cause_ns", "i8"),
    ]
)
ANSWER: Final = np.dtype([("number", "u8"), ("refused", "u8"), ("twist", "f8", (6,)), ("t_ns", "i8")])
ARM: Final = np.dtype(
    [
        ("lifecycle", "u8"),
        ("failed", "u8"),  # reading it raised the error in the note
        ("t_ns", "i8"),
        ("seq", "i8"),
        ("suspect", "u8"),
        ("T_base_tcp", "f8", (4, 4)),
        ("twist", "f8", (6,)),
        ("joints_t_ns", "i8"),
        ("joints_seq", "i8"),
        ("joint_count", "u8"),
        ("has_torque", "u8"),
        ("q", "f8", (MAX_JOINTS,)),
        ("dq", "f8", (MAX_JOINTS,)),
        ("tau", "f8", (MAX_JOINTS,)),
        ("at_rest", "u8"),
        ("read_ns", "i8"),  # time of the host's reading
        # The host's own record, for analysis after a stop.
        ("moved_ns", "i8"),  # when it was last seen moving
        ("obeyed", "u8"),
        ("executed_ns", "i8"),
        ("requested_ns", "i8"),  # when the task last requested a stop while it moved
        ("stop_ns", "i8"),
        ("rest_ns", "i8"),
        ("stop_speed_m_s", "f8"),
        ("stop_way_m", "f8"),
        ("escalated", "u8"),
    ]
)
FRAME: Final = np.dtype(
    [
        ("t_ns", "i8"),
        ("seq", "i8"),
        ("suspect", "u8"),
        ("has_device_time", "u8"),
        ("t_device_ns", "i8"),
        ("height", "u4"),
        ("width", "u4"),
        ("channels", "u4"),
        ("padding", "u4"),
        ("exposure", "f8"),
        ("gain", "f8"),
    ]
)

MAX_OBJECTS: Final = 16
"""Largest number of free objects of a scene."""

TRUTH: Final = np.dtype(
    [
        ("t_ns", "i8"),
        ("seq", "i8"),
        ("T_f_s", "f8", (4, 4)),
        ("T_world_f", "f8", (4, 4)),
        ("in_contact", "u8"),
        ("slipping", "u8"),
        ("normal_force_n", "f8"),
        ("shear_force_n", "f8", (2,)),
    ]
)
OBJECTS: Final = np.dtype([("t_ns", "i8"), ("seq", "i8"), ("T_world_object", "f8", (MAX_OBJECTS, 4, 4))])

_TAILS = {id(ANSWER): MAX_NOTE_BYTES, id(ARM): MAX_NOTE_BYTES, id(FRAME): MAX_IMAGE_BYTES}


def layout_number(dtype: np.dtype[Any]) -> int:
    """Return a hash of the layout, by which both sides check that they agree."""
    return VERSION << 32 | zlib.crc32(repr(dtype.descr).encode())


def create_block(name: str, dtype: np.dtype[Any]) -> int:
    """Create a block for records of ``dtype``; return its file descriptor."""
    return create(name, layout_number(dtype), dtype.itemsize + _TAILS.get(id(dtype), 0))


class RecordWriter:
    """Write records of one dtype: fill ``value`` by field name, then publish."""

    def __init__(self, fd: int, dtype: np.dtype[Any]) -> None:
        self._block = BlockWriter(fd, layout_number(dtype))
        self.value: Any = np.zeros((), dtype)

    def publish(self, tail: bytes = b"") -> None:
        """Publish ``value`` followed by ``tail``."""
        self._block.write(self.value.tobytes() + tail)

    def close(self) -> None:
        """Unmap the memory."""
        self._block.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class RecordReader:
    """Read records of one dtype."""

    def __init__(self, fd: int, dtype: np.dtype[Any]) -> None:
        self._block = BlockReader(fd, layout_number(dtype))
        self._dtype = dtype
        self._newest: tuple[int, Any, bytes] = (0, np.zeros((), dtype), b"")

    def read(self) -> Any:
        """Return the newest record, all zero before the first; read-only."""
        return self.read_all()[1]

    def read_all(self) -> tuple[int, Any, bytes]:
        """Return the number of the newest record, the record, and its tail. Raises CorruptMessage."""
        if self._block.newest != self._newest[0] and (found := self._block.read()) is not None:
            number, record = found
            value = np.frombuffer(record, self._dtype, 1)[0]
            self._newest = number, value, record[self._dtype.itemsize :]
        return self._newest

    def close(self) -> None:
        """Unmap the memory."""
        self._block.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def write_cause(record: Any, cause: Cause) -> None:
    """Write ``cause`` into a record that has one."""
    record["cause"] = (int(cause.reason), cause.host, cause.t_ns, cause.value_s, cause.limit_s)


def read_cause(record: Any) -> Cause:
    """Return the cause in a record."""
    found = record["cause"]
    return Cause(
        Reason(int(found["reason"])),
        int(found["t_ns"]),
        float(found["value_s"]),
        float(found["limit_s"]),
        int(found["host"]),
    )


def close_fd(fd: int) -> None:
    """Close a descriptor that may be closed already."""
    try:
        os.close(fd)
    except OSError:
        return
