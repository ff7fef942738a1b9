"""Operator requests to a run that has tripped: reset and resume, by a key or from another shell, and their answers.

Another shell connects to a UNIX socket in the run folder, which exists only while the run waits. Its mode lets only
this user connect, and the peer's credentials are checked besides. A message is one packet of bounded size, nothing
blocks the loop, and what is malformed is logged and dropped. Requests made before the run waits do not count.
"""

from __future__ import annotations

import contextlib
import getpass
import json
import logging
import os
import socket
from collections import deque
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final

from touchcell.cell.runtime.local_socket import connect, listen, peer_uid

SOCKET: Final = "operator.socket"
MAX_BYTES: Final = 1024
"""Longest message in either direction."""

_WAIT_S: Final = 10.0
_MOST_CLIENTS: Final = 8
_LONGEST_NAME: Final = 64

logger = logging.getLogger(__name__)


class OperatorRequest(Enum):
    """What may be asked of a run that waits."""

    RESET = "reset"
    RESUME = "resume"


@dataclass(frozen=True, slots=True)
class Request:
    """One request.

    Attributes:
        ask: for what.
        operator: who asks.
        client: connection to another shell; None for a key.
    """

    ask: OperatorRequest
    operator: str
    client: socket.socket | None = None


class OperatorChannel:
    """Takes requests while it is open; nothing that a client, a terminal or a file system does is raised.

    Args:
        folder: the run folder, for requests from other shells; None takes only those of ``ask``.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._asked: deque[Request] = deque()
        self._open = False
        self._server: socket.socket | None = None
        self._clients: deque[socket.socket] = deque()
        self.last_reply = ""

    def open(self) -> None:
        """The run waits from now on. Earlier requests are forgotten."""
        self._asked.clear()
        self.last_reply = ""
        self._open = True
        if self._folder is not None:
            try:
                self._server = listen(self._folder, SOCKET, _MOST_CLIENTS)
            except OSError as error:
                logger.warning("%s: no requests from other shells: %s", self._folder, error)

    def close(self) -> None:
        """The run waits no longer."""
        self._open = False
        for client in self._clients:
            client.close()
        self._clients.clear()
        if self._server is not None and self._folder is not None:
            self._server.close()
            self._server = None
            with contextlib.suppress(OSError):
                (self._folder / SOCKET).unlink()

    def ask(self, ask: OperatorRequest, operator: str) -> None:
        """Ask from within this process."""
        if self._open:
            self._asked.append(Request(ask, operator))

    def take(self) -> Request | None:
        """The next request, or None."""
        if self._server is not None:
            self._accept(self._server)
            for client in tuple(self._clients):
                if (request := self._received(client)) is not None:
                    self._asked.append(request)
        return self._asked.popleft() if self._asked else None

    def answer(self, request: Request, done: bool, reply: str) -> None:
        """Send the outcome of a request to its operator."""
        self.last_reply = reply
        if request.client is not None:
            with contextlib.suppress(OSError):
                request.client.send(json.dumps({"done": done, "reply": reply}).encode()[:MAX_BYTES])
            request.client.close()

    def _accept(self, server: socket.socket) -> None:
        for _ in range(_MOST_CLIENTS):
            try:
                client, _ = server.accept()
            except OSError:
                # Nobody is there, or went away in the meantime.
                return
            if (uid := peer_uid(client)) not in (os.getuid(), 0):
                logger.warning("a request of user %d was refused", uid)
                client.close()
                continue
            client.setblocking(False)
            self._clients.append(client)
            if len(self._clients) > _MOST_CLIENTS:
                self._clients.popleft().close()

    def _received(self, client: socket.socket) -> Request | None:
        try:
            data, _, flags, _ = client.recvmsg(MAX_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data, flags = b"", 0
        self._clients.remove(client)
        request = _parsed(data, client) if data and not flags & socket.MSG_TRUNC and _stays(client) else None
        if request is None:
            if data:
                logger.warning("a request that is malformed, or whose sender has gone, was dropped")
            client.close()
        return request


def operator_name() -> str:
    """Name of the user of this process, or the number of one without a name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return f"uid {os.getuid()}"


def is_waiting(folder: Path) -> bool:
    """Whether the run in ``folder`` has tripped and waits for its operator."""
    try:
        with connect(folder, SOCKET, _WAIT_S):
            return True
    except OSError:
        return False


def ask_run(folder: Path, ask: OperatorRequest, operator: str, wait_s: float = _WAIT_S) -> tuple[bool, str]:
    """Ask the waiting run in ``folder``; returns whether it was done, and the run's reply."""
    try:
        with connect(folder, SOCKET, wait_s) as client:
            client.send(json.dumps({"ask": ask.value, "operator": operator}).encode())
            answer = json.loads(client.recv(MAX_BYTES))
            return bool(answer["done"]), str(answer["reply"])
    except (OSError, ValueError, KeyError, TypeError):
        return False, "no answer: does the run still wait?"


def _stays(client: socket.socket) -> bool:
    """Whether a client still waits for its answer: what it has given up must not be done."""
    try:
        return client.recv(1, socket.MSG_PEEK) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


def _parsed(data: bytes, client: socket.socket) -> Request | None:
    try:
        message: Any = json.loads(data)
        ask, operator = OperatorRequest(message["ask"]), message["operator"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if not isinstance(operator, str) or not operator.isprintable() or not 0 < len(operator) <= _LONGEST_NAME:
        return None
    return Request(ask, operator, client)
