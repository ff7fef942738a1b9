"""Where the moves of a task of steps lead, as far as no sensor decides about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.planned_places import PlannedPlace
from touchcell.tasks.servoing import ARM
from touchcell.tasks.steps.model import Move, Repeat, Retract, Servo, Step

_MOST_FOLLOWED = 2000
"""Steps that are followed, repetitions counted: what drifts out of a box does so before."""


def planned_places(steps: Sequence[Step], T_base_tcp: Array | None, T_tcp_sensor: Array) -> Iterator[PlannedPlace]:
    """Return the goal of every move that is known from the start, or is a pose, and has no condition to end it before.

    A move that is repeated has one each time.

    Args:
        steps: of the task.
        T_base_tcp: (4, 4) where the arm starts; None if that is not known.
        T_tcp_sensor: (4, 4) mount of the sensor.
    """
    return _Way(T_base_tcp, T_tcp_sensor).followed(steps, ("steps",))


class _Way:
    """Where the arm is after the steps so far; None once a sensor has decided about it."""

    def __init__(self, T_base_tcp: Array | None, T_tcp_sensor: Array) -> None:
        self._T_base_tcp = T_base_tcp
        self._T_tcp_sensor = T_tcp_sensor
        self._left = _MOST_FOLLOWED

    def followed(self, steps: Sequence[Step], at: tuple[str | int, ...]) -> Iterator[PlannedPlace]:
        """Return the places to which ``steps`` lead, whose key is ``at``."""
        for index, step in enumerate(steps):
            self._left -= 1
            if self._left < 0:
                return
            key = (*at, index, step.kind)
            if isinstance(step, Repeat):
                yield from self._repeated(step, (*key, "steps"))
            elif isinstance(step, Move):
                goal = _goal(step, self._T_base_tcp, self._T_tcp_sensor)
                self._T_base_tcp = goal if step.until is None else None
                if self._T_base_tcp is not None:
                    name = "by_mm_deg" if step.to_mm_deg is None else "to_mm_deg"
                    yield PlannedPlace((*key, name), ARM, self._T_base_tcp)
            elif isinstance(step, Servo):
                self._T_base_tcp = None
            elif isinstance(step, Retract) and self._T_base_tcp is not None:
                back = np.eye(4)
                back[2, 3] = -1e-3 * step.distance_mm
                self._T_base_tcp = _along(self._T_base_tcp, self._T_tcp_sensor, back)
                yield PlannedPlace((*key, "distance_mm"), ARM, self._T_base_tcp)

    def _repeated(self, step: Repeat, at: tuple[str | int, ...]) -> Iterator[PlannedPlace]:
        for _ in range(step.times):
            before = self._T_base_tcp
            yield from self.followed(step.steps, at)
            # What does not change the place leads nowhere else the next time.
            if self._left < 0 or self._T_base_tcp is before:
                return


def _goal(step: Move, T_base_tcp: Array | None, T_tcp_sensor: Array) -> Array | None:
    """Return the goal (4, 4) of a move that begins at a pose; None where that cannot be known."""
    if step.to_mm_deg is not None:
        return se3.from_euler_mm_deg(np.array(step.to_mm_deg))
    if T_base_tcp is None or step.by_mm_deg is None or step.frame == "contact":
        return None
    by = se3.from_euler_mm_deg(np.array([*step.by_mm_deg, 0.0, 0.0, 0.0][:6]))
    if step.frame == "base":
        goal = T_base_tcp.copy()
        goal[:3, 3] += by[:3, 3]
        goal[:3, :3] = by[:3, :3] @ T_base_tcp[:3, :3]
        return goal
    return _along(T_base_tcp, np.eye(4) if step.frame == "tool" else T_tcp_sensor, by)


def _along(T_base_tcp: Array, T_tcp_frame: Array, by: Array) -> Array:
    """Return the pose (4, 4) displaced by ``by`` (4, 4) along the axes of a frame of the tool."""
    moved: Array = T_base_tcp @ T_tcp_frame @ by @ se3.inverse(T_tcp_frame)
    return moved
