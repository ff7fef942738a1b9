"""The C shim of emulated cameras: compiled on first use, preloaded into programs or called from Python."""

from __future__ import annotations

import ctypes
import hashlib
import mmap
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from touchcell.drivers.core.errors import ConnectError
from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.drivers.v4l2.node import KernelCalls

EMULATED_CAMERAS: Final = "TOUCHCELL_V4L2"
"""Variable that names the folder of emulated cameras."""

_SOURCE = Path(__file__).with_name("shim.c")


def library() -> Path:
    """Return the path of the compiled shim in the cache folder ($XDG_CACHE_HOME or ~/.cache), compiling it if needed.

    Raises:
        ConnectError: no C compiler, or it failed.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "touchcell"
    path = cache / f"v4l2_shim-{hashlib.sha256(_SOURCE.read_bytes()).hexdigest()[:16]}.so"
    if path.exists():
        return path
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise ConnectError("v4l2 emulator", "no C compiler found", hint="install gcc or clang")
    cache.mkdir(parents=True, exist_ok=True)
    # Renamed into place, so that two tests compiling at once never load a partial file.
    with tempfile.TemporaryDirectory(dir=cache) as folder:
        built = Path(folder) / path.name
        made = subprocess.run(
            [compiler, "-O2", "-fPIC", "-shared", "-o", str(built), str(_SOURCE), "-ldl", "-lpthread"],
            capture_output=True,
            text=True,
            check=False,
        )
        if made.returncode:
            raise ConnectError("v4l2 emulator", f"{compiler} failed:\n{made.stderr}", hint="install libc6-dev")
        built.rename(path)
    return path


def environment(folder: Path) -> dict[str, str]:
    """Return the variables that make the cameras of ``folder`` visible to any program. Raises ConnectError."""
    return {"LD_PRELOAD": str(library()), EMULATED_CAMERAS: str(folder)}


class ShimCalls(KernelCalls):
    """System calls on the cameras of ``folder`` within this process. Raises ConnectError like ``library``."""

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder).encode()
        self._shim = ctypes.CDLL(str(library()), use_errno=True)
        self._shim.touchcell_v4l2_ioctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)

    def now_ns(self) -> int:
        return emulated_clock().now_ns()

    def open(self, path: str) -> int:
        name = os.path.basename(path).encode()
        return self._checked(self._shim.touchcell_v4l2_open(self._folder, name, os.O_RDWR | os.O_NONBLOCK), path)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int32) -> None:
        self._checked(self._shim.touchcell_v4l2_ioctl(fd, request, ctypes.byref(argument)))

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        return super().map(self._shim.touchcell_v4l2_memory(fd), length, offset)

    def close(self, fd: int) -> None:
        self._checked(self._shim.touchcell_v4l2_close(fd))

    def _checked(self, result: int, path: str | None = None) -> int:
        if result < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), path)
        return result
