"""Device fixture: a driver with its emulated device, for the conformance suite and ``touchcell bench devices``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

from touchcell.drivers.core.clock import Clock, MonotonicClock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.spec import AnyDriver, DriverConfig
from touchcell.registry import Registry


class Emulated(Protocol):
    """A device with ground truth and injectable faults: ``EmulatorProcess``, or a simulation's stand-in."""

    def state(self) -> dict[str, Any]:
        """Return the ground truth."""
        ...

    def fault(self, name: str, value: Any = True) -> dict[str, Any]:
        """Inject a fault; return the ground truth."""
        ...

    def clear(self, name: str) -> dict[str, Any]:
        """End a fault; return the ground truth."""
        ...

    def freeze(self) -> None:
        """Suspend it, with its connections open."""
        ...

    def thaw(self) -> None:
        """Resume it."""
        ...

    def kill(self) -> None:
        """Kill it without notice."""
        ...

    def stop(self) -> None:
        """Stop it in an orderly way."""
        ...


@dataclass(frozen=True, slots=True)
class DeviceFixture:
    """How to build one driver and its emulator.

    Attributes:
        spec: the driver.
        start: starts a fresh emulator and waits until it is ready; None for real hardware, which has no ground truth.
        build: builds the DISCONNECTED device for that emulator; called again after a restart.
        config: the device's part of a cell file, for running tasks on the emulator; None if unused.
        configured: builds the device with another configuration; None if unused.
        energising: entry of the emulator's ``state()`` that counts messages which change power, mode or zero; None for
            a device that has no such messages.
        position: entry with the tool's true position [x, y, z] in m (arms), or None for cameras.
        pose: entry with the tool's true pose (4, 4) in the base frame (arms), or None if only its position is known.
        time: entry with the emulator's own time in s, which may lag behind the machine's where that is busy; None if it
            uses the machine's.
        faults: emulator faults to inject, each with the expected reaction of the driver: "transient" (counted,
            continues), "unseen" (continues; the vendor's library hides it), "stale" (StaleData), "fault" (FAULTED).
        reset: fault that resets the emulator, where a check would need a fresh one.
        known: checks that this driver is known to fail, each with the reason.
        state_rate_hz: rate that ``build`` configures, if not the declared one.
        clock: creates the common clock of a check.
        process: whether the emulator is a process of its own, which can hang and vanish while the client runs.
        reachable: whether another process can use the emulator.
        world: entered while the fixture is used, where driver and emulator share a simulated time.
        notes: behaviours known only from public documents.
    """

    spec: AnyDriver
    start: Callable[[], Emulated] | None
    build: Callable[[Clock], Device]
    config: DriverConfig | None = None
    configured: Callable[[Any, Clock], Device] | None = None
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
    reachable: bool = True
    world: AbstractContextManager[object] = field(default_factory=nullcontext)
    notes: tuple[str, ...] = ()


@runtime_checkable
class FixtureFactory(Protocol):
    """Function that builds the device fixture of a driver."""

    __name__: str

    def __call__(self, folder: Path, address: int, /) -> DeviceFixture:
        """Build a fixture with its files in ``folder``; fixtures of different ``address`` share no port or bus."""
        ...


RIGS: Final = Registry("touchcell.rigs", "rig", FixtureFactory)
"""Fixtures of all drivers that have an emulator, by the driver's name."""

RIGS_IN_STEP: Final = Registry("touchcell.rigs_in_step", "rig", FixtureFactory)
"""Fixtures of the drivers that share a simulated time with their emulators, by the driver's name."""
