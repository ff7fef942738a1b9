"""Cost of an arm in another process: latency of a command, and time of a cycle's reading and sending."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from tests.fault_injection.two_arms import two_arm_plan
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.drivers.core.commands import TwistCommand, TwistFrame

_CYCLES: Final = 500
_RATE_HZ: Final = 100.0
_GUARDED_HZ: Final = 20.0
"""Slower than commanded: the load of the machine is not measured."""


@dataclass(frozen=True, slots=True)
class ProcessCost:
    """Times of two arms at 100 Hz, microseconds.

    Attributes:
        one_way: from before a twist is sent until the arm's gate has passed it.
        cycle: reading and commanding both arms, one after the other.
    """

    one_way: Mapping[str, float]
    cycle: Mapping[str, float]


def measure(folder: Path, processes: str, cycles: int = _CYCLES) -> ProcessCost:
    """Drive two slow arms with everything in ``one`` process or in ``separate`` ones."""
    one_way_ns: list[int] = []
    cycle_ns: list[int] = []
    with compose(two_arm_plan(folder, _GUARDED_HZ, processes=processes)) as cell:
        leases = {name: arm.acquire("bench") for name, arm in cell.arms.items()}
        cell.watchdog.begin()
        start_ns = cell.clock.now_ns()
        for k in range(cycles):
            cell.watchdog.beat()
            started_ns = time.monotonic_ns()
            for name, lease in leases.items():
                one_way_ns.append(_drive(cell, name, lease))
            cycle_ns.append(time.monotonic_ns() - started_ns)
            cell.clock.sleep_until_ns(start_ns + round((k + 1) * 1e9 / _RATE_HZ))
        cell.watchdog.end()
        for name, lease in leases.items():
            cell.arms[name].release(lease)
    return ProcessCost(_quantiles_us(one_way_ns), _quantiles_us(cycle_ns))


def _drive(cell: Cell, name: str, lease: Any) -> int:
    arm = cell.arms[name]
    arm.tcp()
    now_ns = time.monotonic_ns()
    twist = np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    # A long time-to-live: pauses of the machine are not measured.
    sent = arm.send_twist(TwistCommand(twist, TwistFrame.BASE, now_ns, 0.5), lease)
    return int(sent.t_ns) - now_ns


def _quantiles_us(durations_ns: list[int]) -> dict[str, float]:
    return {name: round(1e-3 * float(np.percentile(durations_ns, q)), 1) for name, q in (("p50", 50), ("p99", 99))}
