"""Between a task and the cell that runs it: what the task sees each cycle and what it asks for.

A task never touches a device. The run loop reads the devices, hands over an ``Observation``, puts the ``Action``
through the supervisor, and sends what is left. So every task is tested with plain data and an injected clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict

from touchcell.drivers.core.commands import TwistCommand
from touchcell.drivers.core.protocols import require_protocols
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.registry import Registry


class TaskConfig(BaseModel):
    """Base of every task's parameters: unknown keys refused, values frozen, units in the names."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, slots=True)
class Observation:
    """What the cell knows at one control cycle.

    Attributes:
        now_ns: time of the cycle.
        arms: newest state of each arm, by role in the task ("arm", "leader", ...).
        contacts: newest estimate of each tactile sensor, by role ("sensor", ...); a role is missing until its first
            frame has been processed.
        operator_stop: whether a person asked for an orderly end.
        ended: whether no sensor will deliver anything more, because recordings have been played.
    """

    now_ns: int
    arms: Mapping[str, Stamped[TcpState]]
    contacts: Mapping[str, ContactEstimate]
    operator_stop: bool = False
    ended: bool = False


@dataclass(frozen=True, slots=True)
class Action:
    """What the task asks for in one control cycle.

    Attributes:
        twists: a command for each arm that shall move; an arm without one is told to stop.
        telemetry: named numbers for recording and plots, units in the names.
        labels: contact T_f_s (4, 4) that the newest frame of a sensor shows, by role: the frame is kept with it.
    """

    twists: Mapping[str, TwistCommand] = field(default_factory=dict)
    telemetry: Mapping[str, float] = field(default_factory=dict)
    labels: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TransitionRecord:
    """One change of a task's state."""

    t_ns: int
    source: str
    event: str
    target: str
    reason: str = ""


class Task(Protocol):
    """A task in execution."""

    @property
    def state(self) -> str:
        """Name of the present state."""
        ...

    @property
    def finished(self) -> bool:
        """Whether a terminal state has been reached."""
        ...

    @property
    def succeeded(self) -> bool:
        """Whether that state means that the task did what it promises."""
        ...

    @property
    def transitions(self) -> tuple[TransitionRecord, ...]:
        """Every change of state so far."""
        ...

    def tick(self, observation: Observation) -> Action:
        """Advance by one cycle. Never blocks, never raises for what devices may do."""
        ...

    def trip(self, now_ns: int, reason: str) -> None:
        """The supervisor has latched: go to the tripped state, from which nothing moves."""
        ...


@dataclass(frozen=True, slots=True)
class TaskContext:
    """What a task needs to know of the cell that it will run in.

    Attributes:
        rate_hz: control cycles per second.
        T_tcp_sensor: pose (4, 4) of each sensor role in the tool frame of the arm that carries it.
        kept: how many labelled frames earlier runs of this cell have left.
    """

    rate_hz: float
    T_tcp_sensor: Mapping[str, Array]
    kept: int = 0


TaskConfigT = TypeVar("TaskConfigT", bound=TaskConfig)


@dataclass(frozen=True, slots=True)
class TaskSpec(Generic[TaskConfigT]):
    """A task's entry point (group ``touchcell.tasks``).

    Attributes:
        name: the word in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of its parameters.
        arms: roles of arms, and the Protocols (``touchcell.drivers.core.protocols``) that each driver must provide.
        sensors: roles of tactile sensors it needs.
        build: makes the task from its parameters and the context.
        labels_frames: whether it labels frames, which the cell has to put somewhere.
    """

    name: str
    summary: str
    config: type[TaskConfigT]
    arms: Mapping[str, frozenset[type]]
    sensors: frozenset[str]
    build: Callable[[TaskConfigT, TaskContext], Task]
    labels_frames: bool = False

    def __post_init__(self) -> None:
        for protocols in self.arms.values():
            require_protocols(protocols)


AnyTask: TypeAlias = TaskSpec[Any]
"""A task that was found by name: its configuration is what its own model validates."""

TASKS: Final[Registry[AnyTask]] = Registry("touchcell.tasks", "task", TaskSpec)
"""All installed tasks."""
