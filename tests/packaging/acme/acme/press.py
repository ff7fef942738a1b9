"""A task: zero the scale, then press down until it reads a force."""

import numpy as np

from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.protocols import SERVO_ARM, ReadingSource, SettingSink
from touchcell.tasks.interface import Action, Observation, TaskConfig, TaskContext, TaskSpec, TransitionRecord


class PressConfig(TaskConfig):
    """Keys of the task."""

    force_n: float
    speed_mm_s: float = 5.0


class Press:
    """The task in execution."""

    def __init__(self, config: PressConfig, context: TaskContext) -> None:
        self._config, self.state = config, "zero"
        self.transitions: tuple[TransitionRecord, ...] = ()
        self.finished = self.succeeded = False

    def tick(self, observation: Observation) -> Action:
        now_ns, force_n = observation.now_ns, observation.devices["scale"].value["force_n"]
        if self.state == "zero":
            self._enter("press", now_ns)
            return Action(settings={"scale": {"zero_n": force_n}})
        if force_n >= self._config.force_n or observation.operator_stop:
            self._enter("done", now_ns)
            self.finished, self.succeeded = True, force_n >= self._config.force_n
            return Action()
        down = np.array([0.0, 0.0, -1e-3 * self._config.speed_mm_s, 0.0, 0.0, 0.0])
        return Action({"arm": TwistCommand(down, TwistFrame.BASE, now_ns, 0.1)}, {"force_n": force_n})

    def trip(self, now_ns: int, reason: str) -> None:
        self._enter("tripped", now_ns, reason)
        self.finished = True

    def _enter(self, state: str, now_ns: int, reason: str = "") -> None:
        self.transitions += (TransitionRecord(now_ns, self.state, state, state, reason),)
        self.state = state


SPEC = TaskSpec(
    name="acme_press",
    summary="press down until a scale reads a force",
    config=PressConfig,
    arms={"arm": SERVO_ARM},
    sensors=frozenset({"sensor"}),
    devices={"scale": frozenset({ReadingSource, SettingSink})},
    build=Press,
)
