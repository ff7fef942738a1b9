"""A small file whose room on the disk is taken before it is needed, so that it can be written when the disk is full."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class ReservedFile:
    """A file that appears whole when it is written, and not before.

    Args:
        path: the file; its room is held by a hidden one beside it.
        size: bytes of room.

    Raises:
        OSError: there is no room.
    """

    def __init__(self, path: Path, size: int = 64 * 1024) -> None:
        self.path = path
        self._held = path.with_name(f".{path.name}")
        fd = os.open(self._held, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            os.posix_fallocate(fd, 0, size)
        except OSError:
            self._held.unlink()
            raise
        finally:
            os.close(fd)

    def write(self, text: str) -> None:
        """Write the file, in the room held for it the first time. Raises OSError, and keeps what was there."""
        with self._held.open("r+b" if self._held.exists() else "wb") as file:
            file.write(text.encode())
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        self._held.replace(self.path)

    def discard(self) -> None:
        """Give the room back if the file was never written."""
        with contextlib.suppress(OSError):
            self._held.unlink()
