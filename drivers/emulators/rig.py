"""A driver beside its emulated device: what the conformance suite and ``touchcell bench devices`` run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from drivers.clock import Clock
from drivers.device import Device
from drivers.emulators.process import EmulatorProcess
from drivers.registry import DriverSpec


@dataclass(frozen=True, slots=True)
class Rig:
    """How to bring up one driver on its emulator.

    Attributes:
        spec: the driver.
        start: starts a fresh emulator process and waits until it is ready.
        build: makes the DISCONNECTED device that will find that emulator; called again after a restart.
        energising: entry of the emulator's ``state()`` that counts messages which change power, mode or zero.
        position: entry with the tool's true position [x, y, z] in m (arms), or None for cameras.
        faults: emulator faults to try, each with the driver's lawful answer: "transient" (counted, goes on), "stale"
            (StaleData), "fault" (FAULTED).
        notes: behaviours known only from public documents.
    """

    spec: DriverSpec
    start: Callable[[], EmulatorProcess]
    build: Callable[[Clock], Device]
    energising: str = "energising"
    position: str | None = "position_m"
    faults: dict[str, tuple[Any, str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
