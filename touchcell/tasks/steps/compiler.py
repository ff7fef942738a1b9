"""Compile steps to a checked table of states.

The compiler adds what every task needs: waiting for fresh data, the reactions to stop, trip and fault, a timeout for
every state, and withdrawing before a task that did not succeed ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from touchcell.tasks.state_machine import FAULT, STOP, TRIP, StateDef, Table, TransitionDef
from touchcell.tasks.steps.model import RESERVED, Hold, Leaf, Repeat, Servo, Step, StepsConfig

_MARGIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Loop:
    """One ``repeat``.

    Attributes:
        first, last: states that its body begins and ends with.
        times: how often the body runs.
    """

    first: Enum
    last: Enum
    times: int


@dataclass(frozen=True, slots=True)
class Program:
    """Compiled steps.

    Attributes:
        table: states and transitions.
        steps: the step of each state that has one.
        loops: repetitions, inner before outer; guard ``again_K`` of the table is for ``loops[K]``.
    """

    table: Table
    steps: Mapping[Enum, Leaf]
    loops: tuple[Loop, ...]

    def state(self, name: str) -> Enum:
        """Return the state of that name. Raises KeyError."""
        return type(self.table.states[0].state)[name.upper()]


def compile_steps(config: StepsConfig, task: str = "steps") -> Program:
    """Compile validated steps."""
    names = _names(config.steps)
    members = ["PREPARE", *(name.upper() for name in names), *(name.upper() for name in RESERVED if name != "prepare")]
    states = Enum("StepState", {member: member for member in members})  # type: ignore[misc]
    flat: list[tuple[Enum, Leaf]] = []
    loops: list[Loop] = []
    _flatten(config.steps, [states[name.upper()] for name in names], flat, loops)
    return Program(_table(task, config, states, flat, loops), dict(flat), tuple(loops))


def _names(steps: Sequence[Step]) -> list[str]:
    """Return the names of the leaves' states in order: given, or kind and number."""
    found: list[str] = []
    taken = {*RESERVED}

    def visit(steps: Sequence[Step]) -> None:
        for step in steps:
            if isinstance(step, Repeat):
                visit(step.steps)
            else:
                found.append(step.name or f"{step.kind}_{len(found) + 1}")

    visit(steps)
    for i, name in enumerate(found):
        while name in taken:
            name += "_"
        taken.add(name)
        found[i] = name
    return found


def _flatten(steps: Sequence[Step], states: Sequence[Enum], flat: list[tuple[Enum, Leaf]], loops: list[Loop]) -> None:
    for step in steps:
        if isinstance(step, Repeat):
            first = len(flat)
            _flatten(step.steps, states, flat, loops)
            loops.append(Loop(flat[first][0], flat[-1][0], step.times))
        else:
            flat.append((states[len(flat)], step))


def _table(
    task: str, config: StepsConfig, states: type[Enum], flat: Sequence[tuple[Enum, Leaf]], loops: Sequence[Loop]
) -> Table:
    s = {name: states[name.upper()] for name in RESERVED}
    withdraw_s = config.withdraw_mm / config.withdraw_speed_mm_s * 2.0 + _MARGIN_S
    rows = [
        TransitionDef("ready", s["prepare"], flat[0][0]),
        TransitionDef("timeout", s["prepare"], s["failed"]),
        TransitionDef(STOP, s["prepare"], s["stopped"]),
    ]
    for i, (state, _) in enumerate(flat):
        rows += [
            TransitionDef("done", state, loop.first, f"again_{k}") for k, loop in enumerate(loops) if loop.last is state
        ]
        rows.append(TransitionDef("done", state, flat[i + 1][0] if i + 1 < len(flat) else s["done"]))
        rows.append(TransitionDef("unmet", state, s["withdraw"]))
    rows += [
        TransitionDef("withdrawn", s["withdraw"], s["stopped"], "was_stopped"),
        TransitionDef("withdrawn", s["withdraw"], s["failed"]),
        TransitionDef("timeout", s["withdraw"], s["failed"]),
        TransitionDef("timeout", None, s["withdraw"]),
        TransitionDef(STOP, None, s["withdraw"]),
        TransitionDef(TRIP, None, s["tripped"]),
        TransitionDef(FAULT, None, s["faulted"]),
    ]
    return Table(
        task,
        (
            StateDef(s["prepare"], config.prepare_timeout_s, "timeout"),
            *(StateDef(state, _timeout_s(step), "timeout", on_enter="begin") for state, step in flat),
            StateDef(s["withdraw"], withdraw_s, "timeout", on_enter="begin"),
            *(StateDef(s[name], terminal=True) for name in ("done", "stopped", "failed", "tripped", "faulted")),
        ),
        tuple(rows),
    )


def _timeout_s(step: Leaf) -> float:
    if isinstance(step, Hold):
        return step.time_s + _MARGIN_S
    if isinstance(step, Servo) and step.until.time_s is not None:
        return step.until.time_s + _MARGIN_S
    return getattr(step, "timeout_s", _MARGIN_S)
