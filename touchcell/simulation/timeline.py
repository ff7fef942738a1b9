"""Simulated time on a fixed grid, so that results do not depend on how often it is polled."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from touchcell.drivers.core.clock import Clock

DEFAULT_STEP_S = 0.002

Restore = Callable[[], None]
"""Restores a participant to the state at its snapshot; may be called any number of times."""


class Phase(IntEnum):
    """Order within a step: bodies move first, then contacts follow."""

    MOTION = 0
    CONTACT = 1


class Timeline:
    """Advance participants step by step to the clock's present time, on demand. Single-threaded.

    Args:
        clock: injected clock.
        step_s: step of the simulation grid; steps end at whole multiples of it on the clock.
    """

    def __init__(self, clock: Clock, step_s: float = DEFAULT_STEP_S) -> None:
        self._clock = clock
        self.step_ns = round(step_s * 1e9)
        self._t_ns = clock.now_ns() // self.step_ns * self.step_ns
        self._participants: list[tuple[Phase, Callable[[int], None]]] = []
        self._advancing = False
        self._kept: list[Callable[[], Callable[[int], None]]] = []

    @property
    def t_ns(self) -> int:
        """Time of the last step, at most one step behind the clock after ``advance``."""
        return self._t_ns

    def add(self, phase: Phase, step: Callable[[int], None]) -> None:
        """Call ``step(t_ns)`` for every step, with the time at the step's end."""
        self._participants.append((phase, step))
        self._participants.sort(key=lambda participant: participant[0])

    def keep(self, snapshot: Callable[[], Callable[[int], None]]) -> None:
        """Add a participant to snapshots. ``snapshot()`` returns a function that restores it, given the nanoseconds
        elapsed since."""
        self._kept.append(snapshot)

    def snapshot(self) -> Restore:
        """Return a function that restores all participants to the present state. It leaves the clock alone: their
        remaining motion starts again."""
        t_ns = self.advance()
        parts = [snapshot() for snapshot in self._kept]

        def restore() -> None:
            later_ns = self.advance() - t_ns
            for part in parts:
                part(later_ns)

        return restore

    def advance(self) -> int:
        """Make all steps up to the clock's present time; return ``t_ns``. Within a step it does nothing."""
        if self._advancing:
            return self._t_ns
        self._advancing = True
        try:
            end_ns = self._clock.now_ns()
            while self._t_ns + self.step_ns <= end_ns:
                self._t_ns += self.step_ns
                for _, step in self._participants:
                    step(self._t_ns)
        finally:
            self._advancing = False
        return self._t_ns
