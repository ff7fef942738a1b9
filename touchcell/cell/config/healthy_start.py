"""Rules that would trip although nothing is wrong: shown the cell at its start, with data as old as devices give it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from touchcell.cell.config.armed import NotArmed, arm_roles
from touchcell.cell.config.starts import start_of_arm
from touchcell.control.interlocks.config import build_interlocks
from touchcell.control.interlocks.coverage import CellFacts, with_arm, with_motion
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.latch import unlogged_latch
from touchcell.control.supervisor import Supervisor
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan

_OF_PLACES: Final = ("tilt", "clearance")
_OF_TIMES: Final = ("frame_age", "arm_state_age", "frame_frozen")
_START_NS: Final = 10**12
_SHOWN_S: Final = 0.3
_FRAMES: Final = 3
_LONGEST_S: Final = 2.0
"""Limits of age above it are refused anyway."""


def trips_when_healthy(plan: CellPlan, facts: CellFacts) -> Iterator[NotArmed]:
    """Return every interlock that would trip before the task has done anything.

    Workspaces are held against the start poses with the other places of a cell (``feasibility``).

    Args:
        plan: a checked cell file.
        facts: of the cell.
    """
    starts = _starts(plan)
    frames = {role: _frame_times(plan, role, facts) for role in facts.sensors}
    states_s = {role: _state_period_s(plan, name) for name, role in arm_roles(plan).items()}
    poses = {role: sensor.T_tcp_sensor for role, sensor in facts.sensors.items()}
    first_s = max([0.0, *(latency_s + period_s for latency_s, period_s in frames.values())])
    shown_s = max([_SHOWN_S, *(_FRAMES * period_s for _, period_s in frames.values())])
    cycles = math.ceil(min(shown_s, _LONGEST_S) / facts.period_s)
    for name, entry in plan.cell.interlocks.items():
        at_start = entry.kind in _OF_PLACES
        if not (entry.kind in _OF_TIMES or (at_start and _is_placed(entry, starts, facts))):
            continue
        (interlock,) = build_interlocks({name: entry}, poses, facts.scene)
        latch = unlogged_latch()
        supervisor = Supervisor([interlock], latch)
        for k in range(1 if at_start else cycles):
            t_s = first_s + k * facts.period_s
            supervisor.review(_view(facts, t_s, starts, frames, states_s))
            if (cause := latch.first_cause) is not None:
                yield _problem(plan, name, entry, cause.subject, cause.reason, frames)
                break


def _view(
    facts: CellFacts,
    t_s: float,
    starts: Mapping[str, Array],
    frames: Mapping[str, tuple[float, float]],
    states_s: Mapping[str, float],
) -> CellView:
    """Return the cell at ``t_s``: arms at their start, and the newest frames and states that can have arrived."""
    now_ns = _START_NS + round(1e9 * t_s)
    view = facts.healthy(now_ns, facts.states[0] if facts.states else "")
    for role, period_s in states_s.items():
        view = with_motion(view, role, starts.get(role))
        age_ns = round(1e9 * (t_s - _last(t_s, period_s)))
        view = with_arm(view, role, state=replace(view.arms[role].state, t_ns=now_ns - age_ns))
    sensors = {}
    for role, sensor in view.sensors.items():
        latency_s, period_s = frames[role]
        taken_s = _last(t_s - latency_s, period_s)
        seq = round(taken_s / period_s)
        content = None if sensor.content is None else seq
        sensors[role] = replace(sensor, t_frame_ns=_START_NS + round(1e9 * taken_s), seq=seq, content=content)
    return replace(view, sensors=sensors)


def _last(t_s: float, period_s: float) -> float:
    """Return the last multiple of ``period_s`` up to ``t_s``."""
    return math.floor(t_s / period_s + 1e-9) * period_s


def _starts(plan: CellPlan) -> dict[str, Array]:
    """Return the pose (4, 4) of every arm whose start is known, by role."""
    found = {}
    for name, role in arm_roles(plan).items():
        if (T_base_tcp := start_of_arm(plan, name)) is not None:
            found[role] = T_base_tcp
    return found


def _is_placed(entry: Any, starts: Mapping[str, Array], facts: CellFacts) -> bool:
    """Return whether the poses that decide about an interlock are known: joint angles are not."""
    if entry.kind == "tilt":
        return entry.arm in starts
    return all(role in starts and body.kinematics() is None for role, body in facts.scene.bodies.items())


def _frame_times(plan: CellPlan, role: str, facts: CellFacts) -> tuple[float, float]:
    """Return the latency of a sensor's frames, as far as it is configured, and the time between them, in seconds."""
    config = plan.sensors[plan.sensor_roles[role]].config
    return 1e-3 * float(getattr(config, "latency_ms", 0.0)), 1.0 / facts.sensors[role].frame_rate_hz


def _state_period_s(plan: CellPlan, name: str) -> float:
    return 1.0 / (plan.arms[name].spec.capabilities.state_rate_hz or plan.cell.rate_hz)


def _problem(
    plan: CellPlan, name: str, entry: Any, subject: str, reason: str, frames: Mapping[str, tuple[float, float]]
) -> NotArmed:
    if entry.kind in _OF_PLACES:
        arm = {role: arm for arm, role in arm_roles(plan).items()}[subject]
        reason = f"interlocks.{name} would trip at once there: {reason}"
        return NotArmed(("arms", arm, "start_pose_mm_deg"), reason, "start elsewhere, or put the interlock right")
    if subject in frames:
        latency_s, period_s = frames[subject]
        hint = f"a frame comes every {1e3 * period_s:.3g} ms and is {1e3 * latency_s:g} ms old then: raise the limit"
    else:
        hint = f"a cycle takes {1e3 / plan.cell.rate_hz:g} ms: raise the limit"
    return NotArmed(("interlocks", name, "limit_ms"), f"would trip although nothing is wrong: {reason}", hint)
