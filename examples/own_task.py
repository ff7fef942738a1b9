"""A task of one's own: press down until the sensor feels 2 mm, then it is done. ``touchcell new task`` makes one."""

from dataclasses import replace

import numpy as np

import touchcell as tc
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.protocols import TwistSink
from touchcell.tasks.interface import Action, Observation, TaskConfig, TaskContext, TaskSpec, TransitionRecord


class PressConfig(TaskConfig):
    """Keys of the ``task:`` section."""

    depth_mm: float = 2.0
    speed_mm_s: float = 5.0


class Press:
    """The task in execution: each cycle it sees an observation and answers with an action."""

    def __init__(self, config: PressConfig, context: TaskContext) -> None:
        self._config, self.state = config, "press"
        self.transitions: tuple[TransitionRecord, ...] = ()
        self.finished = self.succeeded = False

    def tick(self, seen: Observation) -> Action:
        contact = seen.contacts.get("sensor")
        depth_mm = 0.0
        if contact is not None and contact.belief is not None:
            depth_mm = -1e3 * float(contact.belief.mean[2, 3])  # the surface lies this far behind the tip
        if depth_mm >= self._config.depth_mm or seen.operator_stop:
            self._end("done" if depth_mm >= self._config.depth_mm else "stopped", seen.now_ns)
            return Action()
        down = np.array([0, 0, -1e-3 * self._config.speed_mm_s, 0, 0, 0])
        return Action({"arm": TwistCommand(down, TwistFrame.BASE, seen.now_ns, 0.1)}, {"depth_mm": depth_mm})

    def trip(self, now_ns: int, reason: str) -> None:
        self._end("tripped", now_ns, reason)

    def _end(self, state: str, now_ns: int, reason: str = "") -> None:
        self.transitions += (TransitionRecord(now_ns, self.state, state, state, reason),)
        self.state, self.finished, self.succeeded = state, True, state == "done"


SPEC = TaskSpec("press", "press down", PressConfig, {"arm": frozenset({TwistSink})}, frozenset({"sensor"}), Press)
cell = tc.load_cell("surface_follow_sim")  # with an entry point for SPEC its file could say `task: {name: press}`
print(tc.run(replace(cell, task=SPEC, task_config=PressConfig(depth_mm=1.5))))
