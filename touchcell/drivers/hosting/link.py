"""Parent side of a child process: start it, call it, monitor it, and end it in any state."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import DeviceFault, DeviceGone, FaultClass, LifecycleError, Remedy, TransportTimeout
from touchcell.drivers.hosting.layouts import Cause, RecordReader, read_cause
from touchcell.drivers.hosting.wire import decode_error, receive, send

_START_S: Final = 30.0
_CALL_S: Final = 60.0
"""Parking an arm takes long."""

_END_S: Final = 5.0
_HANGING_S: Final = 2.0


class Child:
    """A child process with a socket to it. When this process dies, the kernel closes the socket and the child notices.

    Args:
        name: name for operators and errors.
        module: module that ``python -m`` runs.
        spec: its argument, to which the socket is added.
        fds: descriptors to inherit.

    Attributes:
        realtime: scheduling and memory locking that it obtained.
    """

    def __init__(self, name: str, module: str, spec: Mapping[str, Any], fds: Sequence[int]) -> None:
        self.name = name
        self.realtime = ""
        self._calls = 0
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        spec = {**spec, "fds": {**spec["fds"], "socket": theirs.fileno()}}
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, json.dumps(spec)],
                stdin=subprocess.DEVNULL,
                pass_fds=(*fds, theirs.fileno()),
                # A Ctrl-C is for the task, which stops the arms in an orderly way; a child is single-threaded.
                start_new_session=True,
                env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self.process.pid

    def await_ready(self) -> None:
        """Wait until it has built its devices. Raises the error that it reported, or DeviceGone."""
        self.realtime = self._answer(_START_S)["realtime"]

    def call(self, call: str, **arguments: Any) -> dict[str, Any]:
        """Call a function of the child and wait for its reply.

        Raises:
            DeviceGone: the process has died.
            TransportTimeout: it does not reply.
            TouchcellError: error that it raised.
        """
        self._calls += 1
        try:
            send(self._socket, {"call": call, "number": self._calls, **arguments})
        except OSError:
            raise self._gone() from None
        return self._answer(_CALL_S)

    def _answer(self, wait_s: float) -> dict[str, Any]:
        self._socket.settimeout(wait_s)
        try:
            # A reply to a call that timed out is not for this one.
            while (message := receive(self._socket)) is not None and message["number"] != self._calls:
                continue
        except TimeoutError:
            raise TransportTimeout(self.name, "reply of its process", wait_s) from None
        if message is None:
            raise self._gone()
        if not message["ok"]:
            if "error" in message:
                raise decode_error(message["error"], self.name)
            raise LifecycleError(self.name, "execute the call", "guarding", ["not guarded"])
        return message

    def _gone(self) -> DeviceGone:
        return DeviceGone(self.name, f"its process {self.pid} {self.describe_end() or 'has closed its socket'}")

    def describe_end(self) -> str:
        """Describe how it ended; empty while it runs."""
        code = self.process.poll()
        if code is None:
            return ""
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"has ended with code {code}"

    def close(self) -> None:
        """End it by a message and by closing the socket, also if it is suspended; kill it if it does not end."""
        with suppress(OSError):
            send(self._socket, {"call": "end"})
        self._socket.close()
        self.process.send_signal(signal.SIGCONT)
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class HostLink(Child):
    """A device host, with the state that its proxies need.

    Args:
        name: name of the group.
        spec: specification of the devices to build.
        fds: descriptors to inherit.
        beats: reader of its heartbeat.
        silence_s: silence after which it is considered dead.
        clock: CLOCK_MONOTONIC.

    Attributes:
        monitored: whether silence counts: not while it executes a call.
    """

    def __init__(
        self,
        name: str,
        spec: Mapping[str, Any],
        fds: Sequence[int],
        *,
        beats: RecordReader,
        silence_s: float,
        clock: Clock,
    ) -> None:
        super().__init__(name, "touchcell.drivers.hosting.host", spec, fds)
        self._wake: int = spec["fds"]["wake"]
        self._answered: int = spec["fds"]["answered"]
        self.beats = beats
        self._silence_s = silence_s
        self._clock = clock
        self.monitored = False

    def check(self, device: str) -> None:
        """Raise DeviceFault if the host has died, or is silent while it should beat."""
        ended, too_long_s = self.describe_end(), self.silent_too_long()
        if ended or too_long_s:
            raise DeviceFault(
                device,
                f"its process {ended}" if ended else f"its process has been silent for {too_long_s:.3f} s",
                fault_class=FaultClass.COMMUNICATION,
                needs=Remedy.OPERATOR,
                hint="check that the arm is at rest, then start the run again",
            )

    def silent_too_long(self) -> float:
        """Return the silence in s if it is too long; 0 while its arms are not guarded."""
        silent_s = self.silent_s()
        return silent_s if self.monitored and silent_s > self._silence_s else 0.0

    def silent_s(self) -> float:
        """Return the seconds since its last heartbeat."""
        return (self._clock.now_ns() - int(self.beats.read()["t_ns"])) * 1e-9

    def hangs(self) -> bool:
        """Return whether a call would time out; a host also sends heartbeats while its silence does not count."""
        return self.silent_s() > _HANGING_S

    def latched(self) -> Cause | None:
        """Return the cause for which it has stopped its arms, or None."""
        beat = self.beats.read()
        return read_cause(beat) if beat["latched"] else None

    def wake(self) -> None:
        """Make the host poll for a command now."""
        os.eventfd_write(self._wake, 1)

    def await_answer(self, seconds: float) -> None:
        """Wait for a reply of the host, at most ``seconds``."""
        if select.select([self._answered], [], [], seconds)[0]:
            os.eventfd_read(self._answered)
