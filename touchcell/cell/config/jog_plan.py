"""The cell of a file as it is moved by hand: its own arms, sensors, scene and interlocks, with the task ``jog``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.layers import load_layers
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.worlds import WorldName, world_changes
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.errors import ConfigError

SPEED_MM_S: Final = 50.0
TURN_DEG_S: Final = 17.0
_BELOW: Final = 0.8
"""Share of a limit that is asked for, so that the limit itself has nothing to do."""


def jog_settings(
    path: Path,
    world: WorldName | None,
    settings: Mapping[str, Any] | None = None,
    *,
    speed_mm_s: float = SPEED_MM_S,
    turn_deg_s: float = TURN_DEG_S,
) -> tuple[dict[str, Any], list[str]]:
    """Return the settings that put ``jog`` in place of a file's task, and notes for people.

    Roles stay as they are, so that interlocks keep their subjects; interlocks that count only in states of the file's
    task are left out. The scene that a world makes is that of the file's task. A trip waits for the operator.

    Args:
        path: the cell file.
        world: where it runs; None as the file is written.
        settings: values in place of the file's own, by dotted key; they stay.
        speed_mm_s: largest speed; lowered to what the arms and the interlocks allow.
        turn_deg_s: largest angular rate, likewise.

    Raises:
        ConfigError: the file is not valid, or has no arm that can be moved.
    """
    plan = plan_cell(path, settings=settings, to_run=False)
    arms = {role: name for role, name in plan.arm_roles.items() if _provides(plan, name) >= SERVO_ARM}
    if not arms:
        arms = {name: name for name in plan.cell.arms if _provides(plan, name) >= SERVO_ARM}
    if not arms:
        hint = "jog moves arms whose drivers follow twists"
        raise ConfigError("has no arm that can be moved by hand", file=str(path), key="arms", hint=hint)
    carried = {role: name for role, name in plan.sensor_roles.items() if plan.cell.sensors[name].mounted_on}
    fastest_mm_s, fastest_deg_s = _fastest(plan, arms)
    speed_mm_s = min(speed_mm_s, fastest_mm_s)
    found: dict[str, Any] = {
        "task": {
            "name": "jog",
            "arms": arms,
            "sensors": carried,
            "speed_mm_s": round(speed_mm_s, 3),
            "turn_deg_s": round(min(turn_deg_s, fastest_deg_s), 3),
            "touch_speed_mm_s": round(min(8.0, speed_mm_s), 3),
        }
    }
    notes: list[str] = []
    data = load_layers(path, settings).data
    bound = [name for name, entry in plan.cell.interlocks.items() if hasattr(entry, "states")]
    if bound:
        found["interlocks"] = {name: entry for name, entry in data["interlocks"].items() if name not in bound}
        notes.append(f"left out, as they count in states of {plan.task.name}: {', '.join(sorted(bound))}")
    found["on_trip"] = "wait_for_reset"
    if plan.cell.collect is not None:
        found["collect"] = None
    if world in ("sim", "emulated") and plan.cell.world is None:
        kept = ("scene", "emulated_scene")
        changes = world_changes(plan, world).settings
        found |= {key: value for key, value in changes.items() if key in kept or key.endswith(".start_pose_mm_deg")}
    return {**found, **(settings or {})}, notes


def _provides(plan: CellPlan, name: str) -> frozenset[type]:
    return plan.devices[name].spec.capabilities.provides


def _fastest(plan: CellPlan, arms: Mapping[str, str]) -> tuple[float, float]:
    """Return the speed in mm/s and the rate in deg/s that neither a gate nor an interlock has to limit."""
    speeds_mm_s, turns_deg_s = [250.0], [60.0]
    for name in arms.values():
        limits = getattr(plan.devices[name].config, "limits", None)
        if isinstance(limits, LimitsConfig):
            speeds_mm_s.append(1e3 * _BELOW * limits.tcp_speed_m_s)
            turns_deg_s.append(_BELOW * math.degrees(limits.tcp_rot_speed_rad_s))
    for entry in plan.cell.interlocks.values():
        if entry.kind == "tcp_speed":
            speeds_mm_s.append(1e3 * _BELOW * getattr(entry, "limit_m_s", 0.25))
            turns_deg_s.append(_BELOW * math.degrees(getattr(entry, "limit_rad_s", 1.0)))
    return min(speeds_mm_s), min(turns_deg_s)
