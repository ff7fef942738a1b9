"""A driver beside its emulated device: what the conformance suite and ``touchcell bench devices`` run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

from touchcell.drivers.core.clock import Clock, MonotonicClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.spec import DriverConfig, DriverSpec
from touchcell.registry import Registry


class Emulated(Protocol):
    """A device of which the truth is known and that can be hurt: ``EmulatorProcess``, or a simulation's stand-in."""

    def state(self) -> dict[str, Any]:
        """The truth inside."""
        ...

    def fault(self, name: str, value: Any = True) -> dict[str, Any]:
        """Begin a fault; returns the truth."""
        ...

    def clear(self, name: str) -> dict[str, Any]:
        """End a fault; returns the truth."""
        ...

    def freeze(self) -> None:
        """It hangs, with its connections open."""
        ...

    def thaw(self) -> None:
        """It goes on."""
        ...

    def kill(self) -> None:
        """It vanishes."""
        ...

    def stop(self) -> None:
        """It ends in an orderly way."""
        ...


@dataclass(frozen=True, slots=True)
class DeviceFixture:
    """How to bring up one driver on its emulator.

    Attributes:
        spec: the driver.
        start: starts a fresh emulator and waits until it is ready; None on a real bench, where nothing knows the truth.
        build: makes the DISCONNECTED device that will find that emulator; called again after a restart.
        config: the device's part of a cell file, for running tasks on the emulator; None where nobody does.
        energising: entry of the emulator's ``state()`` that counts messages which change power, mode or zero; None for
            a device that has no such messages.
        position: entry with the tool's true position [x, y, z] in m (arms), or None for cameras.
        pose: entry with the tool's true pose (4, 4) in the base frame (arms), or None where only its position is told.
        time: entry with the emulator's own time in s, which may lag behind the machine's where that is busy; None if it
            keeps the machine's.
        faults: emulator faults to try, each with the driver's lawful answer: "transient" (counted, goes on), "unseen"
            (goes on; the vendor's library hides it), "stale" (StaleData), "fault" (FAULTED).
        reset: fault that puts the emulator back to how it started, where a check would need a fresh one.
        known: checks that this driver is known to fail, each with the reason.
        state_rate_hz: rate that ``build`` configures, where it is not the one in the capability record.
        clock: makes the clock that everything in a check runs on.
        process: whether the emulator is a process of its own, which can hang and vanish while the client lives.
        notes: behaviours known only from public documents.
    """

    spec: DriverSpec
    start: Callable[[], Emulated] | None
    build: Callable[[Clock], Device]
    config: DriverConfig | None = None
    energising: str | None = "energising"
    position: str | None = "position_m"
    pose: str | None = None
    time: str | None = None
    faults: dict[str, tuple[Any, str]] = field(default_factory=dict)
    reset: str | None = None
    known: dict[str, str] = field(default_factory=dict)
    state_rate_hz: float | None = None
    clock: Callable[[], Clock] = MonotonicClock
    process: bool = True
    notes: tuple[str, ...] = ()


@runtime_checkable
class FixtureFactory(Protocol):
    """Makes the fixture of one driver."""

    __name__: str

    def __call__(self, folder: Path, address: int, /) -> DeviceFixture:
        """A fixture that keeps its files in ``folder``; fixtures with different ``address`` share no port or bus."""
        ...


RIGS: Final = Registry("touchcell.rigs", "rig", FixtureFactory)
"""Fixtures of all drivers that have an emulator, by the driver's name."""
