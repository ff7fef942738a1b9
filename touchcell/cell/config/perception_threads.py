"""In which thread a cell perceives: the loop's own, or one for each sensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from touchcell.cell.config.cell_plan import CellFile, CellPlan, DevicePlan

FRAME_S: Final = 6e-3
"""What an estimate from a camera frame takes, decoding included: 3.7 to 5.8 ms in docs/benchmarks/sensors.txt."""

SHARE: Final = 0.5
"""Part of a cycle that perception may take before it gets threads of its own."""


def threaded_sensors(cell: CellFile, sensors: Mapping[str, DevicePlan]) -> frozenset[str]:
    """Return the names of the sensors that are perceived in threads of their own.

    A simulated camera is read in the loop's thread whatever the file says: it shares the scene with the arms, and runs
    of one seed must agree. Others get threads where the file asks for them, or where the frames of all sensors, should
    they come in one cycle, take more than half of it.

    Args:
        cell: the file's sections.
        sensors: those that are built.
    """
    able = _able(cell, sensors)
    if cell.perceive_in == "loop":
        return frozenset()
    if cell.perceive_in == "threads" or len(able) * FRAME_S > SHARE * _cycle_s(cell):
        return able
    return frozenset()


def perception_line(plan: CellPlan) -> str:
    """Return in a few words where the cell perceives, and why; empty where nothing reads camera frames."""
    cell = plan.cell
    if not any(cell.sensors[name].estimator.reads_frames for name in plan.sensors):
        return ""
    if not (able := _able(cell, plan.sensors)):
        return "in the loop's thread, as cameras or time are simulated"
    where = "in a thread for each sensor" if threaded_sensors(cell, plan.sensors) else "in the loop's thread"
    if cell.perceive_in != "auto":
        return f"{where}, as perceive_in says"
    takes = f"{len(able)} frame{'s' if len(able) > 1 else ''} of {1e3 * FRAME_S:g} ms"
    more = "more" if len(able) * FRAME_S > SHARE * _cycle_s(cell) else "no more"
    return f"{where}: {takes}, {more} than half of a cycle of {1e3 * _cycle_s(cell):g} ms"


def _cycle_s(cell: CellFile) -> float:
    """Return the machine's time for a cycle."""
    return 1.0 / (cell.rate_hz * (cell.emulated_pace if cell.world == "emulated" else 1.0))


def _able(cell: CellFile, sensors: Mapping[str, DevicePlan]) -> frozenset[str]:
    """Names of the sensors that may be perceived in threads of their own."""
    if cell.time == "simulated":
        return frozenset()
    return frozenset(
        name
        for name, device in sensors.items()
        if cell.sensors[name].estimator.reads_frames and not device.spec.capabilities.needs_scene
    )
