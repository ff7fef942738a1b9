"""Base class of emulators: injectable faults, and a control channel to inject them from outside.

An emulator is one asyncio program. It serves the device's interface and a UNIX socket on which each line is a JSON
request, answered by one JSON line:

    {"fault": "drop", "value": 3}    begin a fault (its meaning and value are in ``Emulator.faults``)
    {"clear": "drop"}                end it
    {"state": true}                  ground truth: pose, energised, counters
    {"quit": true}                   end the process in an orderly way

A fault script is YAML: a list of ``{at_s: 1.2, fault: drop, value: 3}`` or ``{at_s: 2.0, clear: drop}``.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from touchcell.drivers.core.paced_clock import emulated_clock
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry.types import Array
from touchcell.testing.emulation.shared_joints import JointsWriter


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """One line of a fault script."""

    at_s: float
    fault: str
    value: Any = True
    clear: bool = False


class CommandOnset:
    """Time of the last change of motion commands at the emulator, for measuring command latency.

    Attributes:
        t_ns: time in the emulated world of the last change after at least 50 ms without one; 0 before the first.
    """

    _CALM_NS = 50_000_000

    def __init__(self) -> None:
        self.t_ns = 0
        self._content: dict[object, object] = {}
        self._changed_ns = 0

    def note(self, addressee: object, content: object) -> None:
        """Record a motion command; call for each one that arrives."""
        if self._content.get(addressee) == content:
            return
        now_ns = emulated_clock().now_ns()
        if now_ns - self._changed_ns >= self._CALM_NS:
            self.t_ns = now_ns
        self._content[addressee] = content
        self._changed_ns = now_ns


class Emulator(ABC):
    """One emulated device. Subclasses serve the interface and check ``self.active`` where a fault has effect."""

    faults: ClassVar[Mapping[str, str]] = {}
    """Fault name -> one line: its effect and the meaning of its value."""

    def __init__(self) -> None:
        self.active: dict[str, Any] = {}
        self.joints: JointsWriter | None = None

    def publish_joints(self, q: Array) -> None:
        """Publish the true joint angles (n,) rad, for a scene that reads them; arms call it at start and each step."""
        if self.joints is not None:
            self.joints.publish(q)

    @abstractmethod
    async def start(self) -> None:
        """Open the interface; return once a client could connect."""

    @abstractmethod
    async def stop(self) -> None:
        """Close the interface."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return the ground truth, JSON-serialisable, for tests and operators."""

    def begin(self, fault: str, value: Any = True) -> None:
        """Inject a fault. Raises ConfigError for an unknown one."""
        self._known(fault)
        self.active[fault] = value
        self.on_fault(fault, value)

    def end(self, fault: str) -> None:
        """End a fault."""
        self._known(fault)
        self.active.pop(fault, None)
        self.on_clear(fault)

    def on_fault(self, fault: str, value: Any) -> None:
        """Act at once where checking ``self.active`` later is not enough (unplug, protective stop)."""

    def on_clear(self, fault: str) -> None:
        """Undo the effects of ``on_fault``."""

    def spend(self, fault: str) -> bool:
        """For faults whose value is a count: use one up; return whether there was one."""
        left = int(self.active.get(fault, 0))
        if left <= 0:
            return False
        if left == 1:
            del self.active[fault]
        else:
            self.active[fault] = left - 1
        return True

    def _known(self, fault: str) -> None:
        if fault not in self.faults:
            raise ConfigError(
                f"unknown fault {fault!r}", key="fault", value=fault, hint=f"known: {', '.join(sorted(self.faults))}"
            )


def read_fault_script(path: Path) -> list[FaultEvent]:
    """Read a fault script, sorted by time. Raises ConfigError naming the entry."""
    entries = yaml.safe_load(path.read_text()) or []
    events = []
    for number, entry in enumerate(entries, start=1):
        try:
            clear = "clear" in entry
            events.append(
                FaultEvent(
                    at_s=float(entry["at_s"]),
                    fault=str(entry["clear" if clear else "fault"]),
                    value=entry.get("value", True),
                    clear=clear,
                )
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                f"entry {number} is not a fault event: {error!r}",
                file=str(path),
                key=f"[{number}]",
                value=entry,
                hint="write {at_s: 1.2, fault: drop, value: 3} or {at_s: 2.0, clear: drop}",
            ) from None
    return sorted(events, key=lambda event: event.at_s)


async def serve(
    emulator: Emulator, control: Path | None = None, script: Sequence[FaultEvent] = (), *, lifeline: bool = False
) -> None:
    """Run ``emulator`` with its control channel and fault script until ``quit``, SIGTERM or SIGINT.

    With ``lifeline`` it also ends when its standard input closes, i.e. when its parent process has ended.

    Prints one line ``ready`` on standard output once interface and control channel are open.
    """
    done = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, done.set)
    if lifeline:
        loop.add_reader(sys.stdin.fileno(), _end_at_eof, done)
    await emulator.start()
    server = await asyncio.start_unix_server(_control(emulator, done), path=str(control)) if control else None
    player = asyncio.create_task(_play(emulator, script))
    print("ready", flush=True)
    try:
        await done.wait()
    finally:
        player.cancel()
        if server is not None:
            server.close()
        await emulator.stop()
        if control is not None:
            control.unlink(missing_ok=True)


def _end_at_eof(done: asyncio.Event) -> None:
    if not os.read(sys.stdin.fileno(), 4096):
        done.set()


def _control(emulator: Emulator, done: asyncio.Event) -> Any:
    async def serve_client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            writer.write(json.dumps(_answer(emulator, done, line)).encode() + b"\n")
            await writer.drain()
        writer.close()

    return serve_client


def _answer(emulator: Emulator, done: asyncio.Event, line: bytes) -> dict[str, Any]:
    try:
        request = json.loads(line)
        if "fault" in request:
            emulator.begin(request["fault"], request.get("value", True))
        elif "clear" in request:
            emulator.end(request["clear"])
        elif "quit" in request:
            done.set()
        return {"ok": True, "state": emulator.state()}
    except (TouchcellError, ValueError, TypeError) as error:
        return {"ok": False, "error": str(error)}


async def _play(emulator: Emulator, script: Sequence[FaultEvent]) -> None:
    start_s = asyncio.get_running_loop().time()
    for event in script:
        await asyncio.sleep(start_s + event.at_s - asyncio.get_running_loop().time())
        if event.clear:
            emulator.end(event.fault)
        else:
            emulator.begin(event.fault, event.value)
