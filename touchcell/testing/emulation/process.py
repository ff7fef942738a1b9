"""An emulator as a child process, for tests and benchmarks: start it, inject faults, read its state, kill it."""

from __future__ import annotations

import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from touchcell.drivers.core.errors import ConnectError, TransportTimeout
from touchcell.geometry.types import Array
from touchcell.testing.emulation.shared_joints import JointsReader, create_joints


class EmulatorProcess:
    """Run ``python -m touchcell.testing.emulation NAME ARGUMENTS`` and use its control channel.

    Args:
        name: emulator, as in ``touchcell emulate NAME``.
        arguments: its command line.
        timeout_s: timeout of its start and of its replies.
    """

    def __init__(self, name: str, *arguments: str, timeout_s: float = 10.0, environment: dict[str, str] | None = None):
        self._name = name
        self._arguments: Sequence[str] = arguments
        self._timeout_s = timeout_s
        self._environment = environment or {}
        self._folder = tempfile.TemporaryDirectory(prefix="touchcell-emulator-")
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._joints: JointsReader | None = None

    @property
    def pid(self) -> int:
        """Process id of the running emulator."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> Self:
        """Start and wait until it is ready. Raises ConnectError with what it printed, or TransportTimeout."""
        control = Path(self._folder.name) / "control"
        log_path = Path(self._folder.name) / "log"
        joints = create_joints(self._name)
        self._joints = JointsReader(joints)
        with log_path.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "touchcell.testing.emulation", self._name, *self._arguments),
                    *("--control", str(control), "--joints", str(joints), "--lifeline"),
                ],
                pass_fds=(joints,),
                # A Ctrl-C in the terminal is for the cell, which needs its devices until it has stopped.
                start_new_session=True,
                # The kernel closes it when this process dies, for any reason.
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=os.environ | self._environment,
            )
        os.close(joints)
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            if not selector.select(self._timeout_s):
                self.kill()
                raise TransportTimeout(self._name, "'ready' of the emulator", self._timeout_s)
        if self._process.stdout.readline().strip() != b"ready":
            self._process.wait()
            raise ConnectError(self._name, f"emulator did not start:\n{log_path.read_text()}")
        self._channel = socket.socket(socket.AF_UNIX)
        self._channel.settimeout(self._timeout_s)
        self._channel.connect(str(control))
        return self

    def fault(self, name: str, value: Any = True) -> dict[str, Any]:
        """Inject a fault; return the emulator's state."""
        return self._ask({"fault": name, "value": value})

    def clear(self, name: str) -> dict[str, Any]:
        """End a fault; return the emulator's state."""
        return self._ask({"clear": name})

    def state(self) -> dict[str, Any]:
        """Return the ground truth of the emulator."""
        return self._ask({"state": True})

    def joints(self) -> Array:
        """Return the newest true joint angles (n,) rad of an arm, also after it has ended.

        Raises:
            ConnectError: this emulator publishes none.
        """
        q = None if self._joints is None else self._joints.newest()
        if q is None:
            raise ConnectError(self._name, "this emulator publishes no joint angles")
        return q

    def wait_for(self, **wanted: Any) -> dict[str, Any]:
        """Poll ``state`` until every named entry has the given value. Raises TransportTimeout."""
        deadline = time.monotonic() + self._timeout_s
        while time.monotonic() < deadline:
            state = self.state()
            if all(state.get(key) == value for key, value in wanted.items()):
                return state
            time.sleep(0.005)
        raise TransportTimeout(self._name, f"state {wanted}", self._timeout_s)

    def freeze(self) -> None:
        """Send SIGSTOP: the device hangs but its sockets stay open."""
        os.kill(self.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Send SIGCONT."""
        os.kill(self.pid, signal.SIGCONT)

    def kill(self) -> None:
        """Send SIGKILL: the device vanishes."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
        self._reap()

    def stop(self) -> None:
        """Stop it in an orderly way, or kill it if it does not end."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
            try:
                self._process.wait(self._timeout_s)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._reap()

    def _reap(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._process is not None:
            self._process.wait()
            for stream in (self._process.stdin, self._process.stdout):
                if stream is not None:
                    stream.close()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self if self._process is not None else self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._channel is not None, "start the emulator first"
        self._channel.sendall(json.dumps(request).encode() + b"\n")
        answer = b""
        while not answer.endswith(b"\n"):
            piece = self._channel.recv(65536)
            if not piece:
                raise ConnectError(self._name, "the emulator has ended")
            answer += piece
        reply = json.loads(answer)
        if not reply["ok"]:
            raise ConnectError(self._name, reply["error"])
        state: dict[str, Any] = reply["state"]
        return state
