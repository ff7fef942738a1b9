"""The emulator's end of a serial line: a pseudo-terminal, or a UNIX socket where both ends share a simulated time.

The kernel passes bytes through a terminal in its own time; those of a socket are there at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import pty
import socket
import struct
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

_LONGEST = 4096
_TCGETS2: Final = 0x802C542A
_TERMIOS2: Final = struct.Struct("=4IB19s2I")


class SerialLine(Protocol):
    """An adapter and its line, from the side of the device."""

    @property
    def plugged(self) -> bool:
        """True while the adapter is plugged in."""
        ...

    def plug_in(self, on_bytes: Callable[[bytes], None]) -> None:
        """Make the adapter appear; ``on_bytes`` is called in the running event loop with what the host sends."""
        ...

    def unplug(self) -> None:
        """Make the adapter disappear."""
        ...

    def write(self, data: bytes) -> None:
        """Send to the host; what does not fit into its buffers is lost."""
        ...

    def baud_rate(self) -> int:
        """Return the baud rate that the host has set."""
        ...


class PtyLine:
    """A pseudo-terminal.

    Args:
        link: symbolic link to create to it.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self._master: int | None = None
        self._slave: int | None = None
        self._rival: int | None = None

    @property
    def plugged(self) -> bool:
        """True while the terminal exists."""
        return self._master is not None

    def plug_in(self, on_bytes: Callable[[bytes], None]) -> None:
        """Open a terminal and link to it."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(self._slave))
        asyncio.get_running_loop().add_reader(self._master, self._read, on_bytes)

    def unplug(self) -> None:
        """Close the terminal."""
        self.release()
        if self._master is not None and self._slave is not None:
            asyncio.get_running_loop().remove_reader(self._master)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = None
            self._link.unlink(missing_ok=True)

    def write(self, data: bytes) -> None:
        """Send to the host."""
        if self._master is not None:
            # A terminal that nothing reads is full: on a wire these bytes would be lost too.
            with contextlib.suppress(OSError):
                os.write(self._master, data)

    def baud_rate(self) -> int:
        """Return the baud rate that the host has set."""
        assert self._master is not None
        # struct termios2 (asm-generic/termbits.h) also has the rates without a constant, such as 76800.
        settings = fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(settings)[-1])

    def hold(self) -> None:
        """Hold the port as another program would; one that finds it held goes away again."""
        if self._slave is not None and self._rival is None:
            self._rival = os.open(os.ttyname(self._slave), os.O_RDWR | os.O_NOCTTY)
            try:
                fcntl.flock(self._rival, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self.release()

    def release(self) -> None:
        """Release the port again."""
        if self._rival is not None:
            os.close(self._rival)
            self._rival = None

    def _read(self, on_bytes: Callable[[bytes], None]) -> None:
        if self._master is not None:
            with contextlib.suppress(OSError):
                on_bytes(os.read(self._master, _LONGEST))


class SocketLine:
    """A UNIX socket, whose other end is a ``SocketPort``.

    Args:
        path: path of the socket.
        baud_rate: baud rate that hosts are taken to have set.
    """

    def __init__(self, path: Path, baud_rate: int) -> None:
        self._path = path
        self._baud_rate = baud_rate
        self._listener: socket.socket | None = None
        self._hosts: list[socket.socket] = []

    @property
    def plugged(self) -> bool:
        """True while the socket listens."""
        return self._listener is not None

    def plug_in(self, on_bytes: Callable[[bytes], None]) -> None:
        """Listen."""
        self._path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.setblocking(False)
        self._listener.bind(str(self._path))
        self._listener.listen()
        asyncio.get_running_loop().add_reader(self._listener, self._accept, on_bytes)

    def unplug(self) -> None:
        """Close the socket and its connections."""
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None
            self._path.unlink(missing_ok=True)
        for host in list(self._hosts):
            self._leave(host)

    def write(self, data: bytes) -> None:
        """Send to the host."""
        for host in list(self._hosts):
            with contextlib.suppress(OSError):
                host.send(data)

    def baud_rate(self) -> int:
        """Return the baud rate that hosts are taken to have set."""
        return self._baud_rate

    def _accept(self, on_bytes: Callable[[bytes], None]) -> None:
        assert self._listener is not None
        host, _ = self._listener.accept()
        host.setblocking(False)
        self._hosts.append(host)
        asyncio.get_running_loop().add_reader(host, self._read, host, on_bytes)

    def _read(self, host: socket.socket, on_bytes: Callable[[bytes], None]) -> None:
        try:
            data = host.recv(_LONGEST)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            on_bytes(data)
        else:
            self._leave(host)

    def _leave(self, host: socket.socket) -> None:
        if host in self._hosts:
            self._hosts.remove(host)
            asyncio.get_running_loop().remove_reader(host)
            host.close()


class SocketPort:
    """The host's end of a ``SocketLine``, with the operations of a pyserial port that drivers use."""

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.connect(path)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._socket.fileno()

    def write(self, data: bytes) -> int:
        """Send. Raises OSError when the adapter is unplugged."""
        return self._socket.send(data)

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes. Raises SerialException when the adapter is unplugged."""
        import serial

        try:
            data = self._socket.recv(size)
        except BlockingIOError:
            return b""
        if not data:
            raise serial.SerialException("the adapter is unplugged")
        return data

    def close(self) -> None:
        """Close the port."""
        self._socket.close()
