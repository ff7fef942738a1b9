"""Joint angles that an emulated arm publishes in shared memory, for the scene around it.

The scene reads where each arm is several hundred times a second. Asking over the control channel made it wait for the
arm's own process each time, and a scene that waits draws no frames; reading shared memory never waits.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from touchcell.drivers.hosting.memory import BlockReader, BlockWriter, create
from touchcell.geometry.types import Array

_LAYOUT: Final = int.from_bytes(b"joints_1", "little")
_MOST_JOINTS: Final = 16


def create_joints(name: str) -> int:
    """Create shared memory for the joint angles of one arm; return its file descriptor, which a child may inherit."""
    return create(f"joints-{name}", _LAYOUT, _MOST_JOINTS * np.dtype(np.float64).itemsize)


class JointsWriter:
    """Publisher of one arm's joint angles.

    Args:
        fd: from ``create_joints``.
    """

    def __init__(self, fd: int) -> None:
        self._block = BlockWriter(fd, _LAYOUT)

    def publish(self, q: Array) -> None:
        """Publish the joint angles (n,) rad."""
        self._block.write(np.ascontiguousarray(q, dtype=np.float64).tobytes())


class JointsReader:
    """Reader of one arm's joint angles.

    Args:
        fd: from ``create_joints``.
    """

    def __init__(self, fd: int) -> None:
        self._block = BlockReader(fd, _LAYOUT)

    def newest(self) -> Array | None:
        """Return the joint angles (n,) rad that were published last; None before the first."""
        record = self._block.read()
        return None if record is None else np.frombuffer(record[1], dtype=np.float64)

    def close(self) -> None:
        """Unmap the memory."""
        self._block.close()
