"""Watchdog chain of a cell, on the task's side: start and end all processes, send heartbeats, report alarms."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import DeviceFault, FaultClass, Remedy
from touchcell.drivers.core.protocols import JointSource
from touchcell.drivers.core.spec import DriverContext
from touchcell.drivers.hosting.groups import Group, HostedDevice
from touchcell.drivers.hosting.layouts import (
    ANSWER,
    ARM,
    COMMAND,
    FRAME,
    HOST,
    OBJECTS,
    TASK,
    TRUTH,
    WATCH,
    Cause,
    Reason,
    RecordReader,
    RecordWriter,
    close_fd,
    create_block,
    read_cause,
)
from touchcell.drivers.hosting.link import Child, HostLink
from touchcell.drivers.hosting.proxies import RemoteArm, RemoteCamera, RemoteDevice, RemoteJointArm
from touchcell.drivers.hosting.watchdog import SLOW_PERIODS, silence_s

if TYPE_CHECKING:
    from touchcell.drivers.hosting.truth import RemoteScene

_GUARD_S: Final = 1.0
_UNGUARDED_SILENCE_S: Final = 2.0
"""Allowed silence while nothing moves and the watchdog does not guard."""


class Chain:
    """Device hosts and watchdog of one cell. A context manager that starts them and always ends them.

    Args:
        groups: devices of each host.
        control_hz: control cycles per second.
        seed: seed of simulated devices.
        clock: CLOCK_MONOTONIC.

    Attributes:
        devices: proxies of all hosted devices, by name, available from the beginning.
        scene: proxy of the scene in a host; None if there is no scene.
        state_fds: descriptors of the arms' state blocks, by name, while it runs.
    """

    def __init__(self, groups: Sequence[Group], control_hz: float, seed: int, clock: Clock) -> None:
        self.groups = tuple(groups)
        self.period_s = 1.0 / control_hz
        self._seed = seed
        self._clock = clock
        self.devices: dict[str, Device] = {each.name: _proxy(each, clock) for group in groups for each in group.devices}
        self.scene = next((_remote_scene(group.scene) for group in groups if group.scene is not None), None)
        self.state_fds: dict[str, int] = {}
        self._links: list[HostLink] = []
        self._watchdog: Child | None = None
        self._exit = ExitStack()

    @property
    def silence_s(self) -> float:
        """Silence after which a process is considered dead."""
        return silence_s(self.period_s)

    @property
    def arms(self) -> dict[str, RemoteArm]:
        """The arms of all hosts."""
        return {name: device for name, device in self.devices.items() if isinstance(device, RemoteArm)}

    @property
    def watchdog(self) -> Child:
        """The watchdog's process."""
        assert self._watchdog is not None, "start the chain first"
        return self._watchdog

    @property
    def hosts(self) -> Sequence[HostLink]:
        """Processes of the hosts, one per group."""
        return self._links

    def __enter__(self) -> Self:
        with self._exit:
            self._start()
            self._exit = self._exit.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exit.close()
        self._links, self._watchdog = [], None

    def begin(self) -> None:
        """Send a heartbeat, make the watchdog guard, and wait until it does. Raises DeviceFault if it does not."""
        # The time before was not a period of the loop.
        self.beat()
        self._task.value["guard"] = True
        self.beat()
        deadline_ns = self._clock.now_ns() + round(1e9 * _GUARD_S)
        while not self.guarding:
            if self.watchdog.describe_end() or self._clock.now_ns() > deadline_ns:
                description = self.watchdog.describe_end() or f"does not reply within {_GUARD_S:g} s"
                raise DeviceFault("watchdog", description, fault_class=FaultClass.COMMUNICATION, needs=Remedy.OPERATOR)
            self.sleep(self.period_s / 10)
            self.beat()
        for link in self._links:
            link.monitored = True

    def beat(self) -> None:
        """Send a heartbeat; once per cycle of the loop."""
        value = self._task.value
        now_ns = self._clock.now_ns()
        period_ns = now_ns - int(value["t_ns"])
        if value["guard"] and period_ns > SLOW_PERIODS * self.period_s * 1e9:
            value["late"] += 1
            value["late_ns"] = period_ns
        value["count"] += 1
        value["t_ns"] = now_ns
        self._task.publish()

    def end(self) -> None:
        """End guarding: all arms have been ordered to stop, and hosts refuse motion from here on."""
        for link in self._links:
            link.monitored = False
        self._task.value["guard"] = False
        self.beat()

    def now_ns(self) -> int:
        """Return the time on the clock that all processes share."""
        return self._clock.now_ns()

    def sleep(self, seconds: float) -> None:
        """Wait on that clock."""
        self._clock.sleep_until_ns(self._clock.now_ns() + round(1e9 * seconds))

    def alarm(self) -> Cause | None:
        """Return why all arms have been stopped, or None. Without guarding: why guarding cannot begin."""
        if not self._task.value["guard"]:
            return self._find_cause(max(self.silence_s, _UNGUARDED_SILENCE_S))
        watch = self._watch.read()
        cause: Cause | None
        if watch["stop"] and (cause := read_cause(watch)).reason is not Reason.HOST_LATCHED:
            return cause
        for number, link in enumerate(self._links):
            if (cause := link.latched()) is not None:
                return cause
            if link.monitored and link.describe_end():
                return Cause(Reason.HOST_GONE, self._clock.now_ns(), host=number)
            if too_long_s := link.silent_too_long():
                return Cause(Reason.HOST_SILENT, self._clock.now_ns(), too_long_s, self.silence_s, number)
        return self._watchdog_silent(self.silence_s)

    def _find_cause(self, longest_s: float) -> Cause | None:
        """Return a process that has ended or has been silent for longer than ``longest_s``; None if all run."""
        for number, link in enumerate(self._links):
            now_ns = self._clock.now_ns()
            if link.describe_end():
                return Cause(Reason.HOST_GONE, now_ns, host=number)
            if (silent_s := link.silent_s()) > longest_s:
                return Cause(Reason.HOST_SILENT, now_ns, silent_s, longest_s, number)
        return self._watchdog_silent(longest_s)

    def _watchdog_silent(self, longest_s: float) -> Cause | None:
        now_ns = self._clock.now_ns()
        silent_s = (now_ns - int(self._watch.read()["t_ns"])) * 1e-9
        return Cause(Reason.WATCHDOG_SILENT, now_ns, silent_s, longest_s) if silent_s > longest_s else None

    @property
    def guarding(self) -> bool:
        """Return whether the watchdog guards; otherwise hosts execute no motion."""
        return bool(self._watch.read()["guarding"])

    def clear(self) -> None:
        """Clear a stop after ``end``, with all arms at rest and all leases released. Moves nothing.

        Raises:
            LifecycleError: an arm moves, or its lease is held.
            DeviceFault: a process has ended or is silent.
        """
        deadline_ns = self._clock.now_ns() + round(1e9 * _GUARD_S)
        # Calls to processes that do not reply would wait for long.
        while (cause := self._find_cause(self.silence_s)) is not None or self.guarding:
            if self._clock.now_ns() > deadline_ns:
                description = "the watchdog still guards" if cause is None else cause.reason.description
                raise DeviceFault("chain", description, fault_class=FaultClass.COMMUNICATION, needs=Remedy.OPERATOR)
            self.sleep(self.period_s / 4)
        self.watchdog.call("clear")
        for link in self._links:
            link.call("clear")

    def note_to(self, path: Path) -> None:
        """Have the watchdog write causes and stop records to ``path``, even if this process has died."""
        self.watchdog.call("notes", path=str(path.absolute()))

    def hold_watchdog(self, held: bool) -> None:
        """Suspend or resume the watchdog's process: for the self-test."""
        os.kill(self.watchdog.pid, signal.SIGSTOP if held else signal.SIGCONT)

    def _start(self) -> None:
        task_fd, watch_fd = self._block("task", TASK), self._block("watch", WATCH)
        blocks: list[dict[str, Any]] = [
            {
                "watch": watch_fd,
                "wake": self._event(),
                "answered": self._event(),
                "host": self._block(f"{group.name}-host", HOST),
                "devices": {each.name: self._device_blocks(each, group) for each in group.devices},
                **({} if group.scene is None else {"objects": self._block(f"{group.name}-objects", OBJECTS)}),
            }
            for group in self.groups
        ]
        self._task = self._exit.enter_context(RecordWriter(task_fd, TASK))
        self._watch = self._exit.enter_context(RecordReader(watch_fd, WATCH))
        for group, fds in zip(self.groups, blocks, strict=True):
            self._links.append(self._start_host(group, fds))
        self.state_fds = {
            each.name: fds["devices"][each.name]["state"]
            for group, fds in zip(self.groups, blocks, strict=True)
            for each in group.devices
            if each.is_arm
        }
        watched = {
            "task": task_fd,
            "watch": watch_fd,
            "hosts": [fds["host"] for fds in blocks],
            "wakes": [fds["wake"] for fds in blocks],
            "arms": self.state_fds,
        }
        spec = {"period_s": self.period_s, "fds": watched}
        self._watchdog = Child("watchdog", "touchcell.drivers.hosting.watchdog", spec, _numbers(watched))
        self._exit.callback(self._watchdog.close)
        # All start at the same time.
        for link, fds in zip(self._links, blocks, strict=True):
            link.await_ready()
            for name, device_fds in fds["devices"].items():
                device = self.devices[name]
                assert isinstance(device, RemoteDevice)
                device.attach(link, device_fds)
                self._exit.callback(device.detach)
            if self.scene is not None and "objects" in fds:
                truths = {name: each["truth"] for name, each in fds["devices"].items() if "truth" in each}
                self.scene.attach(truths, fds["objects"])
                self._exit.callback(self.scene.detach)
        self._watchdog.await_ready()

    def _start_host(self, group: Group, fds: Mapping[str, Any]) -> HostLink:
        spec = {
            "name": group.name,
            "period_s": self.period_s,
            "rate_hz": group.rate_hz(1.0 / self.period_s),
            "seed": self._seed,
            "scene": group.scene,
            "devices": [
                {
                    "name": each.name,
                    "driver": each.spec.name,
                    "config": each.config.model_dump(mode="json"),
                    "category": each.category,
                    "policy": each.policy,
                }
                for each in group.devices
            ],
            "fds": fds,
        }
        beats = self._exit.enter_context(RecordReader(fds["host"], HOST))
        link = HostLink(group.name, spec, _numbers(fds), beats=beats, silence_s=self.silence_s, clock=self._clock)
        self._exit.callback(link.close)
        return link

    def _device_blocks(self, device: HostedDevice, group: Group) -> dict[str, int]:
        wanted = {"command": COMMAND, "answer": ANSWER, "state": ARM} if device.is_arm else {"frame": FRAME}
        if not device.is_arm and group.scene is not None:
            wanted["truth"] = TRUTH
        return {kind: self._block(f"{device.name}-{kind}", dtype) for kind, dtype in wanted.items()}

    def _block(self, name: str, dtype: Any) -> int:
        fd = create_block(name, dtype)
        self._exit.callback(close_fd, fd)
        return fd

    def _event(self) -> int:
        fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._exit.callback(close_fd, fd)
        return fd


def _proxy(device: HostedDevice, clock: Clock) -> RemoteDevice:
    if not device.is_arm:
        return RemoteCamera(device.name, clock)
    if JointSource not in device.spec.capabilities.provides:
        return RemoteArm(device.name, clock)
    # Never connected: it provides the arm's links from its configuration.
    twin = device.spec.build(device.name, device.config, DriverContext(clock))
    return RemoteJointArm(device.name, clock, twin.kinematics() if isinstance(twin, Arm) else None)


def _remote_scene(section: Mapping[str, Any]) -> RemoteScene:
    from touchcell.drivers.hosting.truth import RemoteScene

    return RemoteScene(list(section.get("objects", {})))


def _numbers(fds: Any) -> tuple[int, ...]:
    """Return all descriptors in nested dictionaries and lists."""
    if isinstance(fds, int):
        return (fds,)
    values = fds.values() if isinstance(fds, Mapping) else fds
    return tuple(number for each in values for number in _numbers(each))
