"""What every task with a machine tells the cell about itself, so that a task has only its own behaviour to write."""

from __future__ import annotations

from abc import ABC, abstractmethod

from touchcell.tasks.interface import Action, Observation, TransitionRecord
from touchcell.tasks.state_machine import TRIP, TaskMachine, state_name

DONE = "done"
"""Name of the state in which a task has done what it promises."""


class MachineTask(ABC):
    """A task in execution; ``touchcell.tasks.interface.Task`` documents its members. Subclasses make ``_machine``."""

    _machine: TaskMachine

    @property
    def state(self) -> str:
        """Name of the present state."""
        return state_name(self._machine.state)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states that it may be in before it has finished, the first one first."""
        return tuple(state_name(state) for state in self._machine.active_states)

    @property
    def finished(self) -> bool:
        """Whether a terminal state has been reached."""
        return self._machine.finished

    @property
    def succeeded(self) -> bool:
        """Whether that state is ``done``."""
        return self.state == DONE

    @property
    def transitions(self) -> tuple[TransitionRecord, ...]:
        """Every change of state so far."""
        return self._machine.records

    def trip(self, now_ns: int, reason: str) -> None:
        """Go to the tripped state, from which nothing moves."""
        self._machine.fire(TRIP, reason, now_ns=now_ns)

    @abstractmethod
    def tick(self, observation: Observation) -> Action:
        """Advance by one cycle."""
