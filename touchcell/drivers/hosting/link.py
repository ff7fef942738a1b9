"""The task's side of one child process: started, spoken to, watched, and ended, whatever state it is in."""

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
from touchcell.drivers.hosting.layouts import Cause, RecordReader, cause_of
from touchcell.drivers.hosting.wire import decode_error, receive, send

_START_S: Final = 30.0
_CALL_S: Final = 60.0
"""Parking an arm takes its time."""

_END_S: Final = 5.0
_HANGING_S: Final = 2.0


class Child:
    """A child process with a socket to it. When this process dies, the kernel closes the socket and the child knows.

    Args:
        name: for people and errors.
        module: what ``python -m`` runs.
        spec: its argument, to which the socket is added.
        fds: descriptors that it inherits.

    Attributes:
        realtime: what scheduling and memory it got.
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
                # A Ctrl-C is for the task, which stops the arms in an orderly way; one thread is all that a child has.
                start_new_session=True,
                env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self.process.pid

    def await_ready(self) -> None:
        """Wait until it has built what it owns. Raises the error that it met, or DeviceGone."""
        self.realtime = self._answer(_START_S)["realtime"]

    def call(self, call: str, **arguments: Any) -> dict[str, Any]:
        """Have it do something and wait until it is done.

        Raises:
            DeviceGone: the process has died.
            TransportTimeout: it does not answer.
            TouchcellError: what it raised.
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
            # What answers a call that was given up is not for this one.
            while (message := receive(self._socket)) is not None and message["number"] != self._calls:
                continue
        except TimeoutError:
            raise TransportTimeout(self.name, "answer of its process", wait_s) from None
        if message is None:
            raise self._gone()
        if not message["ok"]:
            if "error" in message:
                raise decode_error(message["error"], self.name)
            raise LifecycleError(self.name, "do what was asked", "guarding", ["nobody is guarded"])
        return message

    def _gone(self) -> DeviceGone:
        return DeviceGone(self.name, f"its process {self.pid} {self.end_words() or 'has closed its socket'}")

    def end_words(self) -> str:
        """How it ended, in words; empty while it lives."""
        code = self.process.poll()
        if code is None:
            return ""
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"has ended with code {code}"

    def close(self) -> None:
        """End it: by a message and by closing the socket, also if it was stopped; one that does not end is killed."""
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
    """A device host, with what its proxies need.

    Args:
        name: of the group.
        spec: what the host builds.
        fds: what it inherits.
        beats: reader of its beat.
        silence_s: silence after which it is taken for dead.
        clock: CLOCK_MONOTONIC.

    Attributes:
        judged: whether silence counts: not while it is busy with what it was called for.
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
        self.judged = False

    def check(self, device: str) -> None:
        """Raise DeviceFault if the host has died, or is silent while it should beat."""
        ended, too_long_s = self.end_words(), self.silent_too_long()
        if ended or too_long_s:
            raise DeviceFault(
                device,
                f"its process {ended}" if ended else f"its process has been silent for {too_long_s:.3f} s",
                fault_class=FaultClass.COMMUNICATION,
                needs=Remedy.OPERATOR,
                hint="see that the arm stands, then start the run again",
            )

    def silent_too_long(self) -> float:
        """How long (s) it has been silent, if that is too long; 0 while its arms are not guarded."""
        silent_s = self.silent_s()
        return silent_s if self.judged and silent_s > self._silence_s else 0.0

    def silent_s(self) -> float:
        """How long (s) ago it gave its last beat."""
        return (self._clock.now_ns() - int(self.beats.read()["t_ns"])) * 1e-9

    def hangs(self) -> bool:
        """Whether a call would wait in vain; a host beats also while nobody judges it."""
        return self.silent_s() > _HANGING_S

    def latched(self) -> Cause | None:
        """Why it has stopped its arms, or None."""
        beat = self.beats.read()
        return cause_of(beat) if beat["latched"] else None

    def wake(self) -> None:
        """Let the host look for a command now."""
        os.eventfd_write(self._wake, 1)

    def await_answer(self, seconds: float) -> None:
        """Wait until the host has answered something, or for ``seconds``."""
        if select.select([self._answered], [], [], seconds)[0]:
            os.eventfd_read(self._answered)
