"""UNIX sockets in a run folder, by which other processes of the same user reach a run. One packet is one message."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_CREDENTIALS: Final = struct.Struct("3i")


def listen(folder: Path, name: str, most_clients: int) -> socket.socket:
    """Return a listening socket in ``folder`` that never blocks and that only this user may connect to.

    Raises:
        OSError: the folder cannot hold one.
    """
    server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        with _address(folder, name) as address:
            with contextlib.suppress(FileNotFoundError):
                (folder / name).unlink()
            server.bind(address)
            # Nothing can connect before it listens.
            (folder / name).chmod(0o600)
        server.setblocking(False)
        server.listen(most_clients)
    except OSError:
        server.close()
        raise
    return server


def connect(folder: Path, name: str, wait_s: float) -> socket.socket:
    """Return a connection to the run in ``folder``.

    Raises:
        OSError: nothing listens there, or it belongs to another user.
    """
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        client.settimeout(max(wait_s, 1e-3))
        with _address(folder, name) as address:
            client.connect(address)
        if peer_uid(client) not in (os.getuid(), 0) and os.getuid() != 0:
            raise PermissionError(f"{folder}: the run belongs to another user")
    except OSError:
        client.close()
        raise
    return client


def peer_uid(connection: socket.socket) -> int:
    """Return the user at the other end."""
    _, uid, _ = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return int(uid)


@contextlib.contextmanager
def _address(folder: Path, name: str) -> Iterator[str]:
    """The socket's address by way of a descriptor: a path in an address has 107 bytes at most."""
    fd = os.open(folder, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{fd}/{name}"
    finally:
        os.close(fd)
