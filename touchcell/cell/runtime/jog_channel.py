"""Jog input from other processes: a page's server, or the process that reads a gamepad.

They connect to a UNIX socket in the run folder, which only this user may, and send what is held as often as they know
it anew. Each message says when, on the machine's monotonic clock; a connection that ends counts as let go. So a killed
or hung input process, a closed tab and a lost network are all the same: silence. Nothing here blocks the loop, and what
is malformed ends its connection.
"""

from __future__ import annotations

import json
import logging
import math
import socket
import time
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from touchcell.cell.runtime.local_socket import connect, listen, peer_uid
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.jog import JogFrame, JogInput, JogMode, JogRequest
from touchcell.drivers.core.samples import Stamped

SOCKET: Final = "jog.socket"
MAX_BYTES: Final = 4096
"""Longest message in either direction."""
_MOST_CLIENTS: Final = 4
_MOST_MESSAGES: Final = 64
"""Of a client in one cycle."""
_LONGEST_NAME: Final = 40
_KEPT_NS: Final = 300_000_000
"""The input that moves an arm keeps it from the others until it has been silent for so long."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class JogMessage:
    """What an input process sends.

    Attributes:
        held_ns: when the operator was last known to hold what is asked for, on CLOCK_MONOTONIC.
        request: what is asked for; None while nothing is held.
        seq: rises with each new deflection.
        stop: "" or "at once" or "end".
        save: name under which the pose of the arm ``save_arm`` is saved; empty for none.
        save_arm: role.
    """

    held_ns: int
    request: JogRequest | None = None
    seq: int = 0
    stop: str = ""
    save: str = ""
    save_arm: str = ""

    def encoded(self) -> bytes:
        """Return the message as one packet."""
        data: dict[str, Any] = {"held_ns": self.held_ns, "seq": self.seq}
        if (asked := self.request) is not None:
            data["request"] = {
                "arm": asked.arm,
                "mode": asked.mode.value,
                "axes": list(asked.axes),
                "frame": asked.frame.value,
                "share": asked.share,
                "step_m": asked.step_m,
                "step_rad": asked.step_rad,
            }
        data |= {key: value for key in ("stop", "save", "save_arm") if (value := getattr(self, key))}
        return json.dumps(data).encode()


def parsed_request(data: Any) -> JogRequest:
    """Return the request of a message.

    Raises:
        ValueError, KeyError, TypeError: it is none.
    """
    x, y, z, a, b, c = (float(each) for each in data["axes"])
    numbers = [float(data.get(key, default)) for key, default in (("share", 1.0), ("step_m", 0.0), ("step_rad", 0.0))]
    if not all(math.isfinite(each) for each in (x, y, z, a, b, c, *numbers)):
        raise ValueError("a number is not finite")
    frame = JogFrame(data.get("frame", JogFrame.BASE.value))
    return JogRequest(str(data["arm"]), JogMode(data["mode"]), (x, y, z, a, b, c), frame, *numbers)


def parsed(packet: bytes) -> JogMessage:
    """Return the message of a packet.

    Raises:
        ValueError, KeyError, TypeError, RecursionError: it is none.
    """
    data = json.loads(packet)
    request = data.get("request")
    stop, save = str(data.get("stop", "")), str(data.get("save", ""))
    if stop not in ("", "at once", "end") or len(save) > _LONGEST_NAME or not save.isprintable():
        raise ValueError("no such stop or name")
    return JogMessage(
        int(data["held_ns"]),
        None if request is None else parsed_request(request),
        int(data.get("seq", 0)),
        stop,
        save,
        str(data.get("save_arm", "")),
    )


@dataclass
class _Client:
    connection: socket.socket
    number: int
    held: Stamped[JogRequest] | None = None


class JogChannel:
    """What other processes hold; see ``touchcell.drivers.core.jog.JogInput``. A context manager, open inside.

    Args:
        folder: the run folder.
        stop: asked by clients.
        save: called with an arm and a name; returns what to show.
        monotonic_ns: the clock of clients' stamps.
    """

    def __init__(
        self,
        folder: Path,
        stop: StopRequest,
        save: Callable[[str, str], str],
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._folder = folder
        self._stop = stop
        self._save = save
        self._monotonic_ns = monotonic_ns
        self._server: socket.socket | None = None
        self._clients: list[_Client] = []
        self._numbers = 0
        self.message = ""

    def __enter__(self) -> JogChannel:
        self._server = listen(self._folder, SOCKET, _MOST_CLIENTS)
        return self

    def __exit__(self, *_: object) -> None:
        for client in self._clients:
            client.connection.close()
        self._clients.clear()
        if self._server is not None:
            self._server.close()
            self._server = None
            with suppress(OSError):
                (self._folder / SOCKET).unlink()

    def held(self, now_ns: int) -> Mapping[Hashable, Stamped[JogRequest]]:
        """Return what each client holds, stamped on the clock of ``now_ns``. Never blocks, never raises."""
        self._accept()
        offset_ns = now_ns - self._monotonic_ns()
        for client in tuple(self._clients):
            self._read(client)
        return {
            client.number: replace(client.held, t_ns=client.held.t_ns + offset_ns)
            for client in self._clients
            if client.held is not None
        }

    def show(self, status: Mapping[str, Any]) -> None:
        """Send what is to be shown to every client; one that does not read misses it."""
        packet = json.dumps(status).encode()
        if len(packet) > MAX_BYTES:
            return
        for client in self._clients:
            with suppress(OSError):
                client.connection.send(packet, socket.MSG_DONTWAIT)

    def _accept(self) -> None:
        for _ in range(_MOST_CLIENTS):
            try:
                assert self._server is not None
                connection, _ = self._server.accept()
            except OSError:
                # No client is there, or it went away in the meantime.
                return
            if len(self._clients) >= _MOST_CLIENTS or peer_uid(connection) not in (0, peer_uid(self._server)):
                logger.warning("an input process was refused")
                connection.close()
                continue
            connection.setblocking(False)
            self._numbers += 1
            self._clients.append(_Client(connection, self._numbers))

    def _read(self, client: _Client) -> None:
        for _ in range(_MOST_MESSAGES):
            try:
                packet = client.connection.recv(MAX_BYTES)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            try:
                if not packet:
                    raise ValueError("it has ended")
                self._take(client, parsed(packet))
            except (ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
                logger.info("input process %d: %s", client.number, error)
                self._clients.remove(client)
                client.connection.close()
                return

    def _take(self, client: _Client, message: JogMessage) -> None:
        if message.held_ns > self._monotonic_ns():
            raise ValueError("it is stamped in the future")
        if message.stop == "at once":
            self._stop.ask_at_once()
        elif message.stop:
            self._stop.ask()
        if message.save:
            self.message = self._save(message.save_arm, message.save)
        request = message.request
        client.held = None if request is None else Stamped(request, message.held_ns, message.seq)


class JogInputs:
    """One jog input of several: the one that is held first has the arm until it lets go.

    Args:
        keyboard: of the terminal, if there is one.
        channel: of other processes, if they may connect.
    """

    def __init__(self, keyboard: JogInput | None, channel: JogChannel | None) -> None:
        self._keyboard = keyboard
        self._channel = channel
        self._owner: Hashable = None
        self._last: tuple[Hashable, int] | None = None
        self._seq = 0

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        """Return what is asked for now; see ``JogInput``."""
        held = {} if self._channel is None else dict(self._channel.held(now_ns))
        if self._keyboard is not None and (pressed := self._keyboard.request(now_ns)) is not None:
            held["keyboard"] = pressed
        fresh = {key: each for key, each in held.items() if now_ns - each.t_ns <= _KEPT_NS}
        if self._owner not in fresh:
            self._owner = max(fresh, key=lambda key: fresh[key].t_ns, default=None)
        if self._owner is None:
            return None
        found = fresh[self._owner]
        if (self._owner, found.seq) != self._last:
            self._last = self._owner, found.seq
            self._seq += 1
        return replace(found, seq=self._seq)


class JogSender:
    """The other end, in an input process.

    Args:
        folder: the run folder.
        wait_s: for the connection.

    Raises:
        OSError: no run takes jog input there.
    """

    def __init__(self, folder: Path, wait_s: float = 5.0) -> None:
        self._connection = connect(folder, SOCKET, wait_s)
        self._connection.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when there is something to show."""
        return self._connection.fileno()

    def send(self, message: JogMessage) -> bool:
        """Send; returns False once the run has ended. A run that does not read misses the message."""
        try:
            self._connection.send(message.encoded())
        except BlockingIOError:
            return True
        except OSError:
            return False
        return True

    def shown(self) -> dict[str, Any] | None:
        """Return the newest of what is to be shown since the last call; None where there is nothing new.

        Raises:
            EOFError: the run has ended.
        """
        newest = None
        while True:
            try:
                packet = self._connection.recv(MAX_BYTES)
            except BlockingIOError:
                return newest
            except OSError:
                packet = b""
            if not packet:
                raise EOFError
            newest = json.loads(packet)

    def close(self) -> None:
        """End the connection, which counts as letting go."""
        self._connection.close()
