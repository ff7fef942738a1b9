"""Where the moves of a task of steps lead, as far as no sensor decides about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.planned_places import PlannedPlace
from touchcell.tasks.servoing import ARM
from touchcell.tasks.steps.model import Move, Repeat, Retract, Servo, Step

_MOST_TIMES = 100
"""Repetitions that are followed: what drifts out of a box does so before."""


def planned_places(steps: Sequence[Step], T_base_tcp: Array | None, T_tcp_sensor: Array) -> Iterator[PlannedPlace]:
    """Return the goal of every move that is known from the start, or is a pose, and has no condition to end it before.

    A move that is repeated has one each time.

    Args:
        steps: of the task.
        T_base_tcp: (4, 4) where the arm starts; None if that is not known.
        T_tcp_sensor: (4, 4) mount of the sensor.
    """
    yield from _followed(steps, ("steps",), [T_base_tcp], T_tcp_sensor)


def _followed(
    steps: Sequence[Step], at: tuple[str | int, ...], now: list[Array | None], T_tcp_sensor: Array
) -> Iterator[PlannedPlace]:
    """Follow ``steps`` from the pose in ``now``, which is kept up to date; None there is a pose that is not known."""
    for index, step in enumerate(steps):
        key = (*at, index, step.kind)
        if isinstance(step, Repeat):
            for _ in range(min(step.times, _MOST_TIMES)):
                before = now[0]
                yield from _followed(step.steps, (*key, "steps"), now, T_tcp_sensor)
                if now[0] is before or now[0] is None:
                    break
        elif isinstance(step, Move):
            goal = _goal(step, now[0], T_tcp_sensor)
            now[0] = goal if step.until is None else None
            if goal is not None and step.until is None:
                yield PlannedPlace((*key, "by_mm_deg" if step.to_mm_deg is None else "to_mm_deg"), ARM, goal)
        elif isinstance(step, Servo):
            now[0] = None
        elif isinstance(step, Retract) and now[0] is not None:
            back = np.eye(4)
            back[2, 3] = -1e-3 * step.distance_mm
            now[0] = _along(now[0], T_tcp_sensor, back)
            yield PlannedPlace((*key, "distance_mm"), ARM, now[0])


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
