"""Base class of tasks with a state machine."""

from __future__ import annotations

from abc import ABC, abstractmethod

from touchcell.tasks.interface import Action, Observation, TransitionRecord
from touchcell.tasks.state_machine import TRIP, Table, TaskMachine, state_name

DONE = "done"
"""Name of the state in which a task has succeeded."""


class MachineTask(ABC):
    """A running task; ``touchcell.tasks.interface.Task`` documents its members. Subclasses set ``_machine``."""

    _machine: TaskMachine

    @property
    def state(self) -> str:
        """Name of the current state."""
        return state_name(self._machine.state)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the non-terminal states, the initial one first."""
        return tuple(state_name(state) for state in self._machine.active_states)

    @property
    def table(self) -> Table:
        """States and transitions."""
        return self._machine.table

    @property
    def finished(self) -> bool:
        """True if a terminal state has been reached."""
        return self._machine.finished

    @property
    def succeeded(self) -> bool:
        """True if that state is ``done``."""
        return self.state == DONE

    @property
    def transitions(self) -> tuple[TransitionRecord, ...]:
        """All transitions so far."""
        return self._machine.records

    def trip(self, now_ns: int, reason: str) -> None:
        """Enter the tripped state, from which nothing moves."""
        self._machine.fire(TRIP, reason, now_ns=now_ns)

    @abstractmethod
    def tick(self, observation: Observation) -> Action:
        """Process one cycle."""
