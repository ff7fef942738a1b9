"""Observe: perception without an arm, on a live camera or on recorded images, until stopped or until they end."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, auto

import numpy as np
from pydantic import PositiveFloat

from touchcell.errors import TouchcellError
from touchcell.geometry import se3
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Action, Observation, TaskConfig, TaskContext, TaskSpec
from touchcell.tasks.servoing import SENSOR
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, StateDef, Table, TaskMachine, TransitionDef
from touchcell.tasks.state_machine_task import MachineTask

_LABELS = ("shear_x_mm", "shear_y_mm", "depth_mm", "tilt_alpha_deg", "tilt_beta_deg", "torsion_gamma_deg")


class ObserveConfig(TaskConfig):
    """Parameters of observing.

    Attributes:
        first_frame_timeout_s: longest wait for the first frame.
        idle_timeout_s: the source counts as ended when no new frame has come for this long.
        duration_s: longest duration of the task.
    """

    first_frame_timeout_s: PositiveFloat = 5.0
    idle_timeout_s: PositiveFloat = 1.0
    duration_s: PositiveFloat = 3600.0


class ObserveState(Enum):
    """States of observing."""

    WAIT = auto()
    OBSERVE = auto()
    DONE = auto()
    FAILED = auto()
    TRIPPED = auto()
    FAULTED = auto()


def observe_table(config: ObserveConfig) -> Table:
    """Return the states and transitions of observing; an operator's stop is its ordinary end."""
    s = ObserveState
    return Table(
        "observe",
        (
            StateDef(s.WAIT, config.first_frame_timeout_s, "timeout"),
            StateDef(s.OBSERVE, config.duration_s, "timeout"),
            StateDef(s.DONE, terminal=True),
            StateDef(s.FAILED, terminal=True),
            StateDef(s.TRIPPED, terminal=True),
            StateDef(s.FAULTED, terminal=True),
        ),
        (
            TransitionDef("frame", s.WAIT, s.OBSERVE),
            TransitionDef("timeout", s.WAIT, s.FAILED),
            TransitionDef("ended", s.WAIT, s.FAILED),
            TransitionDef("ended", s.OBSERVE, s.DONE),
            TransitionDef("timeout", s.OBSERVE, s.DONE),
            TransitionDef(STOP, None, s.DONE),
            TransitionDef(TRIP, None, s.TRIPPED),
            TransitionDef(FAULT, None, s.FAULTED),
        ),
    )


class Observe(MachineTask):
    """The observing task; see ``touchcell.tasks.interface.Task``. It never commands anything."""

    def __init__(self, config: ObserveConfig, context: TaskContext) -> None:
        self._config = config
        self._machine = TaskMachine(observe_table(config), self)
        self._seq: int | None = None
        self._seen_ns = 0
        self._frames = 0

    def tick(self, observation: Observation) -> Action:
        """Process one cycle: no commands, only telemetry."""
        if self.finished:
            return Action()
        if observation.operator_stop:
            self._machine.post(STOP, "operator")
        contact = observation.contacts.get(SENSOR)
        if contact is not None and contact.seq != self._seq:
            self._seq = contact.seq
            self._seen_ns = observation.now_ns
            self._frames += 1
        if observation.ended:
            self._machine.post("ended", "the recording has ended")
        if self._machine.state is ObserveState.WAIT and self._frames:
            self._machine.post("frame")
        idle_s = (observation.now_ns - self._seen_ns) * 1e-9
        if self._machine.state is ObserveState.OBSERVE and idle_s >= self._config.idle_timeout_s:
            self._machine.post("ended", f"no new frame for {idle_s:.3f} s")
        self._machine.tick(observation.now_ns)
        if contact is None:
            return Action()
        try:
            return Action(telemetry=self._telemetry(contact, observation.now_ns))
        except TouchcellError as error:
            self._machine.fire(FAULT, str(error), now_ns=observation.now_ns)
            return Action()

    def _telemetry(self, contact: ContactEstimate, now_ns: int) -> Mapping[str, float]:
        telemetry = {
            "frames": float(self._frames),
            "frame_age_ms": 1e-6 * (now_ns - contact.t_frame_ns),
            "in_contact": float(contact.in_contact),
        }
        if contact.belief is not None:
            components = np.asarray(se3.to_euler_mm_deg(se3.inverse(contact.belief.mean)))
            telemetry |= {label: float(value) for label, value in zip(_LABELS, components, strict=True)}
        return telemetry


SPEC = TaskSpec(
    name="observe",
    summary="show the tactile perception of a sensor, without an arm",
    config=ObserveConfig,
    arms={},
    sensors=frozenset({SENSOR}),
    build=Observe,
)
