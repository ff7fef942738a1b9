"""Interface between a task and the cell that runs it: observations in, actions out.

A task never touches a device. The run loop reads the devices, passes an ``Observation``, checks the ``Action`` with the
supervisor, and sends what it allows. So every task is tested with plain data and an injected clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Literal, Protocol, TypeAlias, TypeVar, runtime_checkable

from pydantic import BaseModel, ConfigDict

from touchcell.drivers.core.commands import TwistCommand
from touchcell.drivers.core.jog import JogRequest
from touchcell.drivers.core.protocols import require_protocols
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.estimator_spec import Feature
from touchcell.registry import Registry
from touchcell.tasks.planned_motions import PlannedMotion
from touchcell.tasks.planned_places import PlannedPlace


@dataclass(frozen=True, slots=True)
class Demand:
    """Annotation of a parameter that asks the same of every run, so that `touchcell check` holds it against the limits.

    Attributes:
        quantity: an indentation in mm, a speed of an arm in mm/s, or a distance to go in mm.
        item: which number of a list it is; None for a single number, or the largest of a list.
    """

    quantity: Literal["depth", "speed", "distance"]
    item: int | None = None


DEPTH: Final = Demand("depth")
CONTACT_DEPTH: Final = Demand("depth", item=2)
"""Of a contact x, y, z, alpha, beta, gamma."""
SPEED: Final = Demand("speed")
DISTANCE: Final = Demand("distance")


class TaskConfig(BaseModel):
    """Base of every task's parameters: unknown keys refused, values frozen, units in the names."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


@dataclass(frozen=True, slots=True)
class Observation:
    """State of the cell at one control cycle.

    Attributes:
        now_ns: time of the cycle.
        arms: newest state of each arm, by role in the task ("arm", "leader", ...).
        contacts: newest estimate of each tactile sensor, by role ("sensor", ...); a role is missing until its first
            frame has been processed.
        devices: newest reading of each other device that is read, by role or, without one, by name.
        operator_stop: True if the operator requested an orderly end.
        ended: True if no sensor will deliver further frames, because the recordings have ended.
        wrenches: (6,) N and N m on the tool centre point along base axes, of each arm of which the task needs it.
        jog: newest request of an operator who moves an arm by hand; None without such an input, or before the first.
    """

    now_ns: int
    arms: Mapping[str, Stamped[TcpState]]
    contacts: Mapping[str, ContactEstimate]
    operator_stop: bool = False
    ended: bool = False
    devices: Mapping[str, Stamped[Mapping[str, float]]] = field(default_factory=dict)
    wrenches: Mapping[str, Stamped[Array]] = field(default_factory=dict)
    jog: Stamped[JogRequest] | None = None


@dataclass(frozen=True, slots=True)
class Action:
    """Commands and data of a task for one control cycle.

    Attributes:
        twists: a command for each arm that shall move; an arm without one is stopped.
        telemetry: named numbers for recording and plots, units in the names.
        labels: contact T_f_s (4, 4) shown by the newest frame of a sensor, by role: the frame is stored with it.
        zero: roles of sensors whose newest frame shows nothing: contacts are measured against it from now on.
        settings: named set values for each other device that shall change, by role; the others keep what they have.
    """

    twists: Mapping[str, TwistCommand] = field(default_factory=dict)
    telemetry: Mapping[str, float] = field(default_factory=dict)
    labels: Mapping[str, Array] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    zero: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class TransitionRecord:
    """One transition of a task's state machine."""

    t_ns: int
    source: str
    event: str
    target: str
    reason: str = ""


class Task(Protocol):
    """A running task."""

    @property
    def state(self) -> str:
        """Name of the current state."""
        ...

    @property
    def finished(self) -> bool:
        """True if a terminal state has been reached."""
        ...

    @property
    def succeeded(self) -> bool:
        """True if that state means that the task has achieved its goal."""
        ...

    @property
    def transitions(self) -> tuple[TransitionRecord, ...]:
        """All transitions so far."""
        ...

    def tick(self, observation: Observation) -> Action:
        """Process one cycle. Never blocks, and never raises for a device's behaviour."""
        ...

    def trip(self, now_ns: int, reason: str) -> None:
        """Enter the tripped state, from which nothing moves, because the supervisor has latched."""
        ...


@runtime_checkable
class Conditional(Protocol):
    """Task whose success is true only as far as something holds that it has no means to measure."""

    @property
    def rests_on(self) -> Sequence[str]:
        """What that is, each in a phrase that continues "done, as far as"."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Where a point of an arm's tool may be, along the axes of the arm's base.

    Attributes:
        lever_m: (3,) the point in the tool frame.
        min_m, max_m: corners (3,) in the base frame.
    """

    lever_m: Array
    min_m: Array
    max_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Cone:
    """Where an axis of an arm's tool may point, in the frame of the arm's base.

    Attributes:
        axis_tcp: (3,) the axis in the tool frame, of length 1.
        direction: (3,) axis of the cone in the base frame, of length 1.
        limit_rad: half of its opening.
    """

    axis_tcp: Array
    direction: Array
    limit_rad: float


@dataclass(frozen=True, slots=True)
class TaskContext:
    """Properties of the cell that a task needs.

    Attributes:
        rate_hz: control cycles per second.
        T_tcp_sensor: pose (4, 4) of each sensor role in the tool frame of the arm that carries it.
        kept: number of labelled frames that earlier runs of this cell have stored.
        resumed: True after a trip of this run: the arms may stand in contact, and its zero frames hold.
        T_world_base: pose (4, 4) of each arm's base, by role; one that is not named stands at the world's origin.
        carriers: role of the arm that carries each sensor role; a sensor that nothing moves is missing.
        boxes: workspaces of each arm role that has any.
        cones: limits on the tilt of each arm role that has any.
        max_depth_m: smallest limit on the indentation of any sensor.
        max_shear_m: smallest limit on its shear.
    """

    rate_hz: float
    T_tcp_sensor: Mapping[str, Array]
    kept: int = 0
    resumed: bool = False
    T_world_base: Mapping[str, Array] = field(default_factory=dict)
    carriers: Mapping[str, str] = field(default_factory=dict)
    boxes: Mapping[str, tuple[Box, ...]] = field(default_factory=dict)
    cones: Mapping[str, tuple[Cone, ...]] = field(default_factory=dict)
    max_depth_m: float = math.inf
    max_shear_m: float = math.inf


TaskConfigT = TypeVar("TaskConfigT", bound=TaskConfig)


@dataclass(frozen=True, slots=True)
class TaskSpec(Generic[TaskConfigT]):
    """A task's entry point (group ``touchcell.tasks``).

    Attributes:
        name: value of ``task`` in the cell file.
        summary: one line for ``touchcell list``.
        config: pydantic model of its parameters.
        arms: roles of arms, and the Protocols (``touchcell.drivers.core.protocols``) that each driver must provide.
        sensors: roles of the tactile sensors it needs.
        build: builds the task from its parameters and the context.
        labels_frames: True if it labels frames, which the cell has to store.
        devices: roles of other devices, and the Protocols that each driver must provide.
        forces: returns roles of arms whose wrench a configuration needs, each with the key that needs it; their drivers
            must provide WrenchSource.
        places: returns where a configuration surely takes an arm, for `touchcell check`, given the pose (4, 4) at which
            the sensor's arm starts, None if that is not known, and the sensor's mount (4, 4).
        motions: returns what a configuration surely does, likewise.
        starts_free: True if its sensors must not touch anything when it begins.
        feature: what the contacts of its sensors must be of; None for a task to which it is the same.
        glides: True if its contacts glide over what they touch, or are carried along by it.
        of_cell: returns the spec with the roles of a cell, for a task whose arms and sensors are those that the cell
            has: called with the roles of the arms and of the sensors that ``task:`` names, or else with all of them.
    """

    name: str
    summary: str
    config: type[TaskConfigT]
    arms: Mapping[str, frozenset[type]]
    sensors: frozenset[str]
    build: Callable[[TaskConfigT, TaskContext], Task]
    labels_frames: bool = False
    devices: Mapping[str, frozenset[type]] = field(default_factory=dict)
    forces: Callable[[TaskConfigT], Mapping[str, str]] | None = None
    starts_free: bool = False
    places: Callable[[TaskConfigT, Array | None, Array], Iterable[PlannedPlace]] | None = None
    motions: Callable[[TaskConfigT, Array | None, Array], Iterable[PlannedMotion]] | None = None
    feature: Feature | None = "surface"
    glides: bool = False
    of_cell: Callable[[frozenset[str], frozenset[str]], TaskSpec[TaskConfigT]] | None = None

    def needs_wrenches(self, config: TaskConfigT) -> Mapping[str, str]:
        """Return roles of arms whose wrench ``config`` needs, each with the key that needs it."""
        return {} if self.forces is None else self.forces(config)

    def __post_init__(self) -> None:
        for protocols in (*self.arms.values(), *self.devices.values()):
            require_protocols(protocols)


AnyTask: TypeAlias = TaskSpec[Any]
"""A task that was found by name: its configuration is what its own model validates."""

TASKS: Final[Registry[AnyTask]] = Registry("touchcell.tasks", "task", TaskSpec)
"""All installed tasks."""
