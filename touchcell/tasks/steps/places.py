"""Where the moves of a task of steps lead and what its steps surely do, as far as no sensor decides about it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.planned_motions import (
    Key,
    PlannedContact,
    PlannedHold,
    PlannedMotion,
    PlannedSlide,
    PlannedStart,
    PlannedTime,
    PlannedTouch,
)
from touchcell.tasks.planned_places import PlannedPlace
from touchcell.tasks.servoing import ARM
from touchcell.tasks.steps.model import Move, Repeat, Retract, Servo, Step, StepsConfig, Until

_MOST_FOLLOWED = 2000
"""Steps that are followed, repetitions counted: what drifts out of a box does so before."""


_FREED_MM: Final = 25.0
"""Way back after which no tip touches any more what it was pressed into: more than its radius."""
_GAIN_PER_S: Final = 10.0
"""Of the way that is left, as a speed, at the end of every move."""
_AHEAD: Final = 0.95
_FELT_FOR_MM: Final = 2.0
"""A move that a touch may end goes on for about so long at least."""


def planned_places(config: StepsConfig, T_base_tcp: Array | None, T_tcp_sensor: Array) -> Iterator[PlannedPlace]:
    """Return the goal of every move that is known from the start, or is a pose, and has no condition to end it before.

    A move that is repeated has one each time.

    Args:
        config: of the task.
        T_base_tcp: (4, 4) where the arm starts; None if that is not known.
        T_tcp_sensor: (4, 4) mount of the sensor.
    """
    for found in _Way(config, T_base_tcp, T_tcp_sensor).followed(config.steps, ("steps",)):
        if isinstance(found, PlannedPlace):
            yield found


def planned_motions(config: StepsConfig, T_base_tcp: Array | None, T_tcp_sensor: Array) -> Iterator[PlannedMotion]:
    """Return what the steps surely do; the arguments are those of ``planned_places``."""
    for found in _Way(config, T_base_tcp, T_tcp_sensor).followed(config.steps, ("steps",)):
        if not isinstance(found, PlannedPlace):
            yield found


class _Way:
    """Where the arm is after the steps so far; None once a sensor has decided about it."""

    def __init__(self, config: StepsConfig, T_base_tcp: Array | None, T_tcp_sensor: Array) -> None:
        self._config = config
        self._T_base_tcp = T_base_tcp
        self._T_tcp_sensor = T_tcp_sensor
        self._left = _MOST_FOLLOWED
        self._may_touch = False
        self._freed_by = ""

    def followed(self, steps: Sequence[Step], at: Key) -> Iterator[PlannedPlace | PlannedMotion]:
        """Return the places to which ``steps``, whose key is ``at``, lead, and what they do."""
        for index, step in enumerate(steps):
            self._left -= 1
            if self._left < 0:
                return
            key = (*at, index, step.kind)
            if isinstance(step, Repeat):
                yield from self._repeated(step, (*key, "steps"))
            elif isinstance(step, Move):
                if step.frame == "contact":
                    yield from self._needs_contact(key, step.until)
                goal = _goal(step, self._T_base_tcp, self._T_tcp_sensor)
                yield from self._moved(step, key, goal)
                self._T_base_tcp = goal if step.until is None else None
                self._may_touch, self._freed_by = self._T_base_tcp is None, ""
                if self._T_base_tcp is not None:
                    name = "by_mm_deg" if step.to_mm_deg is None else "to_mm_deg"
                    yield PlannedPlace((*key, name), ARM, self._T_base_tcp)
            elif isinstance(step, Servo):
                yield from self._needs_contact(key, step.until)
                yield from _servoed(step, key)
                self._T_base_tcp, self._may_touch, self._freed_by = None, True, ""
            elif isinstance(step, Retract):
                yield PlannedStart((*key, "speed_mm_s"), 1e-3 * step.speed_mm_s, 1e-3 * step.distance_mm)
                yield _timed(key, step.distance_mm / step.speed_mm_s, step.timeout_s, "to retract so far")
                if step.distance_mm >= _FREED_MM:
                    self._may_touch, self._freed_by = False, f"retracting by {step.distance_mm:g} mm"
                if self._T_base_tcp is not None:
                    back = np.eye(4)
                    back[2, 3] = -1e-3 * step.distance_mm
                    self._T_base_tcp = _along(self._T_base_tcp, self._T_tcp_sensor, back)
                    yield PlannedPlace((*key, "distance_mm"), ARM, self._T_base_tcp)

    def _needs_contact(self, key: Key, until: Until | None) -> Iterator[PlannedHold]:
        """Return that a step needs a contact, unless an earlier step may have made one or it ends without."""
        ends_s = math.inf if until is None or until.time_s is None else until.time_s
        ends_free = until is not None and until.contact is False
        if not (self._may_touch or ends_free or ends_s <= self._config.stale_timeout_s):
            yield PlannedHold(key, self._T_base_tcp, self._freed_by)

    def _moved(self, step: Move, key: Key, goal: Array | None) -> Iterator[PlannedMotion]:
        """Return how a move to a goal (4, 4) begins, and how long it takes."""
        until, T = step.until, self._T_base_tcp
        if step.velocity_mm_deg_s is not None:
            speed_mm_s = math.hypot(*step.velocity_mm_deg_s[:3])
            way_mm, name = math.inf, "velocity_mm_deg_s"
            ends_s = [math.inf]
        elif step.by_mm_deg is not None or (goal is not None and T is not None):
            by = step.by_mm_deg
            way_mm = math.hypot(*by[:3]) if by is not None else 1e3 * math.dist(goal[:3, 3], T[:3, 3])  # type: ignore[index]
            speed_mm_s, name = min(step.speed_mm_s, _GAIN_PER_S * way_mm), "speed_mm_s"
            ends_s = [way_mm / step.speed_mm_s]
        else:
            return
        felt_mm = way_mm if until is None else min(way_mm, _FELT_FOR_MM)
        presses = until is not None and until.needs_touch and _is_ahead(step)
        yield PlannedStart((*key, name), 1e-3 * speed_mm_s, 1e-3 * felt_mm, presses=presses)
        if until is not None and T is not None and goal is not None:
            yield from self._touched(step, until, key, T, goal)
        if until is None or not until.needs_touch:
            ends_s += _ends(until, speed_mm_s)
            yield _timed(key, min(ends_s), step.timeout_s, "to go so far")

    def _touched(self, step: Move, until: Until, key: Key, T: Array, goal: Array) -> Iterator[PlannedTouch]:
        """Return that a move from a pose to a goal (4, 4) ends by touching something, if nothing else may end it."""
        others = until.force_n is not None or until.time_s is not None or until.distance_mm is not None
        if others or until.contact is False or not until.needs_touch or not np.allclose(T[:3, :3], goal[:3, :3]):
            return
        depth_mm = 0.0 if until.contact or until.depth_mm is None else until.depth_mm
        name = "by_mm_deg" if step.to_mm_deg is None else "to_mm_deg"
        yield PlannedTouch((*key, name), T, goal[:3, 3] - T[:3, 3], 1e-3 * depth_mm)

    def _repeated(self, step: Repeat, at: Key) -> Iterator[PlannedPlace | PlannedMotion]:
        for _ in range(step.times):
            before = self._T_base_tcp
            yield from self.followed(step.steps, at)
            # What does not change the place leads nowhere else the next time.
            if self._left < 0 or self._T_base_tcp is before:
                return


def _is_ahead(step: Move) -> bool:
    """Return whether a move goes along the axis of the sensor."""
    way = step.by_mm_deg or step.velocity_mm_deg_s
    return step.frame == "sensor" and way is not None and way[2] > _AHEAD * math.hypot(*way[:3])


def _servoed(step: Servo, key: Key) -> Iterator[PlannedMotion]:
    """Return what a contact that is held surely does."""
    until = step.until
    if until.needs_touch:
        return
    x, y = step.velocity_mm_deg_s[:2]
    lasts_s = min(_ends(until, math.hypot(*step.velocity_mm_deg_s[:3])))
    if until.time_s is None:
        yield _timed(key, lasts_s, step.timeout_s, "to go so far")
    if not math.isfinite(lasts_s):
        return
    yield PlannedContact(key, lasts_s)
    if speed_mm_s := math.hypot(x, y):
        yield PlannedSlide(
            (*key, "velocity_mm_deg_s"),
            1e-3 * speed_mm_s * lasts_s,
            math.atan2(y, x),
            1e-3 * speed_mm_s,
            1e-3 * step.reference[2],
            known=False,
        )


def _ends(until: Until | None, speed_mm_s: float) -> list[float]:
    """Return the times after which conditions other than touch end a step, s."""
    ends_s = []
    if until is not None and until.time_s is not None:
        ends_s.append(until.time_s)
    if until is not None and until.distance_mm is not None:
        ends_s.append(until.distance_mm / speed_mm_s if speed_mm_s > 0.0 else math.inf)
    return ends_s


def _timed(key: Key, takes_s: float, timeout_s: float, what: str) -> PlannedTime:
    return PlannedTime((*key, "timeout_s"), takes_s, timeout_s, what)


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
