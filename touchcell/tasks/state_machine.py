"""State machines for tasks: a table as data, checked when it is built, run by one thread on injected time.

The engine is ``transitions``, without its pitfalls: no automatic ``to_<state>`` triggers that bypass guards, no timer
threads, no exception that leaves a state half entered, no callback that is found missing only when it is needed, no
guard that fails silently.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from transitions import EventData, Machine, MachineError, State

from touchcell.tasks.errors import TaskDefinitionError
from touchcell.tasks.interface import TransitionRecord

_logger = logging.getLogger(__name__)

STOP: Final = "stop"
"""The operator requests an orderly end."""
TRIP: Final = "trip"
"""An interlock has latched: no motion is allowed."""
FAULT: Final = "fault"
"""An unexpected failure."""

OBLIGATORY: Final = (STOP, TRIP, FAULT)
"""Events that every state but the terminal ones accepts, whatever its guards say."""

REFUSALS_KEPT: Final = 256


def state_name(state: Enum) -> str:
    """Return the name of a state as used in records, messages and diagrams."""
    return state.name.lower()


@dataclass(frozen=True, slots=True)
class StateDef:
    """One state.

    Attributes:
        state: the enum member.
        timeout_s: longest stay; None only for a terminal state, which has no outgoing transition.
        on_timeout: event that ends a stay of ``timeout_s``.
        on_enter: name of the model's method called on entry, as ``method(record)``. It may start work, never block.
        terminal: True if the task ends here.
    """

    state: Enum
    timeout_s: float | None = None
    on_timeout: str | None = None
    on_enter: str | None = None
    terminal: bool = False


@dataclass(frozen=True, slots=True)
class TransitionDef:
    """One row of the table. Rows of the same event are tried from top to bottom.

    Attributes:
        event: trigger.
        source: source state; None for every state that is not terminal.
        target: target state.
        guard: name of the model's method, ``method() -> bool`` without side effects; None for always.
    """

    event: str
    source: Enum | None
    target: Enum
    guard: str | None = None


@dataclass(frozen=True, slots=True)
class Table:
    """A task's states and transitions; the first state is the initial one."""

    task: str
    states: tuple[StateDef, ...]
    transitions: tuple[TransitionDef, ...]

    def sources(self, row: TransitionDef) -> tuple[Enum, ...]:
        """Return the source states of ``row``."""
        if row.source is not None:
            return (row.source,)
        return tuple(definition.state for definition in self.states if not definition.terminal)


@dataclass(frozen=True, slots=True)
class Accepted:
    """The event caused a transition."""

    record: TransitionRecord


@dataclass(frozen=True, slots=True)
class Refused:
    """The event was refused, with the reason."""

    event: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Posted:
    event: str
    reason: str
    epoch: int | None


class _Model:
    """Private model that ``transitions`` decorates with its triggers."""

    state: Enum
    trigger: Callable[..., bool]


class TaskMachine:
    """Run a ``Table``.

    Events are posted from anywhere in the loop and take effect in ``tick``, in order. A posted event may be bound to
    the current stay in a state; if that state is left before it is processed, it is dropped. Timeouts work that way.

    Args:
        table: states and transitions.
        model: has the methods that the table names.

    Attributes:
        table: states and transitions.

    Raises:
        TaskDefinitionError: the table is invalid; lists all problems.
    """

    def __init__(self, table: Table, model: object) -> None:
        if problems := lint(table, model):
            raise TaskDefinitionError(table.task, problems)
        self.table = table
        self._name = table.task
        self._model = model
        self._definitions = {definition.state: definition for definition in table.states}
        self._events = {row.event for row in table.transitions}
        self._queue: deque[_Posted] = deque()
        self._records: list[TransitionRecord] = []
        self._refusals: deque[Refused] = deque(maxlen=REFUSALS_KEPT)
        self._now_ns = 0
        self._entered_ns: int | None = None
        self._epoch = 0
        self._firing: _Posted | None = None
        self._source = table.states[0].state
        self._failed_guards: list[str] = []
        self._engine_model = _Model()
        self._engine = Machine(
            model=self._engine_model,
            states=[State(definition.state) for definition in table.states],
            initial=table.states[0].state,
            transitions=[
                {
                    "trigger": row.event,
                    "source": list(table.sources(row)),
                    "dest": row.target,
                    "conditions": [] if row.guard is None else [self._guard(row.guard)],
                    "after": [self._entered],
                }
                for row in table.transitions
            ],
            auto_transitions=False,
            queued=True,
            send_event=True,
            ignore_invalid_triggers=False,
        )

    @property
    def state(self) -> Enum:
        """Current state."""
        return self._engine_model.state

    @property
    def active_states(self) -> tuple[Enum, ...]:
        """The states that are not terminal, in the order of the table."""
        return tuple(state for state, definition in self._definitions.items() if not definition.terminal)

    @property
    def finished(self) -> bool:
        """True if the current state is terminal."""
        return self._definitions[self.state].terminal

    @property
    def epoch(self) -> int:
        """Number of the current stay in a state; rises with every transition."""
        return self._epoch

    @property
    def records(self) -> tuple[TransitionRecord, ...]:
        """All transitions so far."""
        return tuple(self._records)

    @property
    def refusals(self) -> tuple[Refused, ...]:
        """The latest refused events."""
        return tuple(self._refusals)

    def stay_s(self) -> float:
        """Return the seconds in the current state at the latest tick; 0 before the first."""
        return 0.0 if self._entered_ns is None else (self._now_ns - self._entered_ns) * 1e-9

    def post(self, event: str, reason: str = "", *, epoch: int | None = None) -> None:
        """Queue an event for the next tick; with ``epoch`` only for that stay in a state."""
        self._queue.append(_Posted(event, reason, epoch))

    def tick(self, now_ns: int) -> None:
        """Set the time to ``now_ns``, process the queue, then time out a stay that has lasted too long."""
        self._now_ns = now_ns
        if self._entered_ns is None:
            self._entered_ns = now_ns
        definition = self._definitions[self.state]
        if definition.timeout_s is not None and definition.on_timeout is not None:
            stay_s = self.stay_s()
            if stay_s >= definition.timeout_s:
                self.post(definition.on_timeout, f"{stay_s:.3f} s in {state_name(self.state)}", epoch=self._epoch)
        self._drain()

    def fire(self, event: str, reason: str = "", *, now_ns: int | None = None) -> Accepted | Refused:
        """Process an event at once, ahead of the queue, at ``now_ns`` or the time of the latest tick.

        From within a callback it is refused: post it instead.
        """
        if self._firing is not None:
            return self._refuse(event, f"{self._firing.event!r} is still being processed")
        self._now_ns = self._now_ns if now_ns is None else now_ns
        return self._fire(_Posted(event, reason, None))

    def _drain(self) -> None:
        while self._queue:
            self._fire(self._queue.popleft())

    def _fire(self, posted: _Posted) -> Accepted | Refused:
        if posted.event not in self._events:
            return self._refuse(posted.event, "no such event")
        if posted.epoch is not None and posted.epoch != self._epoch:
            return self._refuse(posted.event, "the state it was bound to has been left")
        self._firing = posted
        self._source = self.state
        self._failed_guards.clear()
        count = len(self._records)
        try:
            self._engine_model.trigger(posted.event, posted=posted)
        except MachineError:
            return self._refuse(posted.event, f"not accepted in {state_name(self.state)}")
        except Exception as error:
            self._fail(f"guard of {posted.event!r} raised {error!r}")
            return self._refuse(posted.event, f"a guard raised {error!r}")
        finally:
            self._firing = None
        if len(self._records) == count:
            return self._refuse(posted.event, f"guard {' and '.join(self._failed_guards)} returned False")
        return Accepted(self._records[count])

    def _entered(self, event: EventData) -> None:
        posted: _Posted = event.kwargs["posted"]
        self._epoch += 1
        self._entered_ns = self._now_ns
        source, target = self._source, self.state
        record = TransitionRecord(self._now_ns, state_name(source), posted.event, state_name(target), posted.reason)
        self._records.append(record)
        _logger.info(
            "%s: %s -> %s by %s%s",
            self._name,
            record.source,
            record.target,
            record.event,
            f" ({record.reason})" if record.reason else "",
        )
        callback = self._definitions[self.state].on_enter
        if callback is None:
            return
        try:
            getattr(self._model, callback)(record)
        except Exception as error:
            self._fail(f"{callback} raised {error!r}")

    def _fail(self, reason: str) -> None:
        # Ahead of the queue: nothing may act in a half-entered state.
        self._queue.appendleft(_Posted(FAULT, reason, None))

    def _refuse(self, event: str, reason: str) -> Refused:
        refused = Refused(event, reason)
        _logger.debug("%s: %s refused: %s", self._name, event, reason)
        self._refusals.append(refused)
        return refused

    def _guard(self, name: str) -> Callable[[EventData], bool]:
        def agrees(event: EventData) -> bool:
            agreed = bool(getattr(self._model, name)())
            if not agreed:
                self._failed_guards.append(name)
            return agreed

        return agrees


def lint(table: Table, model: object) -> list[str]:
    """Return all problems of ``table`` for a task whose methods are ``model``'s; empty if there are none."""
    problems: list[str] = []
    definitions = {definition.state: definition for definition in table.states}
    if len(definitions) != len(table.states):
        problems.append("a state is defined twice")
    for definition in table.states:
        name = state_name(definition.state)
        if definition.terminal:
            if definition.timeout_s is not None or definition.on_timeout is not None or definition.on_enter is not None:
                problems.append(f"terminal state {name} has a timeout or an on_enter")
            continue
        if definition.timeout_s is None or not 0.0 < definition.timeout_s < float("inf"):
            problems.append(f"state {name} has no finite timeout")
        if definition.on_enter is not None and not callable(getattr(model, definition.on_enter, None)):
            problems.append(f"on_enter {definition.on_enter!r} of state {name} does not exist")
        unguarded = [row for row in table.transitions if row.guard is None]
        accepted = {row.event for row in unguarded if definition.state in table.sources(row)}
        needed = (*OBLIGATORY, definition.on_timeout or "(no on_timeout)")
        problems += [f"state {name} does not always accept {event}" for event in needed if event not in accepted]
    problems += _lint_rows(table, definitions, model)
    problems += _lint_graph(table, definitions)
    return problems


def _lint_rows(table: Table, definitions: dict[Enum, StateDef], model: object) -> list[str]:
    problems: list[str] = []
    wildcard_seen = False
    settled: set[tuple[str, Enum]] = set()
    for row in table.transitions:
        if row.guard is not None and not callable(getattr(model, row.guard, None)):
            problems.append(f"guard {row.guard!r} of {row.event} does not exist")
        if row.target not in definitions or (row.source is not None and row.source not in definitions):
            problems.append(f"{row.event} leads from or to a state that is not defined")
            continue
        if row.source is None:
            wildcard_seen = True
        else:
            if wildcard_seen:
                problems.append(f"{row.event} from {state_name(row.source)} comes after a wildcard")
            if definitions[row.source].terminal:
                problems.append(f"{row.event} leaves terminal state {state_name(row.source)}")
            if (row.event, row.source) in settled:
                problems.append(f"{row.event} from {state_name(row.source)} is shadowed by a row without a guard")
        if row.guard is None:
            settled.update((row.event, source) for source in table.sources(row))
    return problems


def _lint_graph(table: Table, definitions: dict[Enum, StateDef]) -> list[str]:
    forward: dict[Enum, set[Enum]] = {state: set() for state in definitions}
    backward: dict[Enum, set[Enum]] = {state: set() for state in definitions}
    for row in table.transitions:
        for source in table.sources(row):
            if source in definitions and row.target in definitions:
                forward[source].add(row.target)
                if row.event not in (TRIP, FAULT):
                    backward[row.target].add(source)
    problems: list[str] = []
    reachable = _closure([table.states[0].state], forward)
    ending = _closure([state for state, definition in definitions.items() if definition.terminal], backward)
    for state in definitions:
        if state not in reachable:
            problems.append(f"state {state_name(state)} cannot be reached")
        if state not in ending:
            problems.append(f"state {state_name(state)} never reaches a terminal state without a trip or a fault")
    return problems


def _closure(start: Sequence[Enum], edges: dict[Enum, set[Enum]]) -> set[Enum]:
    found = set(start)
    frontier = list(start)
    while frontier:
        new = edges[frontier.pop()] - found
        found |= new
        frontier += new
    return found


def mermaid(table: Table) -> str:
    """Return the table as a Mermaid state diagram; events accepted by every active state leave the box around them."""
    active = [definition for definition in table.states if not definition.terminal]
    terminal = [definition for definition in table.states if definition.terminal]
    arrows: dict[tuple[str, str], list[str]] = {}
    for row in table.transitions:
        source = "active" if row.source is None else state_name(row.source)
        label = row.event + (f" [{row.guard}]" if row.guard else "")
        arrows.setdefault((source, state_name(row.target)), []).append(label)
    active_names = {state_name(definition.state) for definition in active}
    lines = ["stateDiagram-v2", "    state active {", f"        [*] --> {state_name(table.states[0].state)}"]
    for inside in (True, False):
        for (source, target), labels in arrows.items():
            if (source in active_names and target in active_names) is inside:
                lines.append(f"{'        ' if inside else '    '}{source} --> {target}: {', '.join(labels)}")
        if inside:
            lines.append("    }")
    lines += [f"    {state_name(definition.state)} --> [*]" for definition in terminal]
    return "\n".join(lines)
