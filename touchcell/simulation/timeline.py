"""Simulated time on a fixed grid, so that results do not depend on who asks how often."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from touchcell.drivers.core.clock import Clock

DEFAULT_STEP_S = 0.002

Restore = Callable[[], None]
"""Puts something back as it was when this was made; may be called any number of times."""


class Phase(IntEnum):
    """Order within a step: bodies move first, then contacts follow."""

    MOTION = 0
    CONTACT = 1


class Timeline:
    """Brings its participants step by step to the clock's now, when somebody asks. One thread only.

    Args:
        clock: injected time.
        step_s: grid of the simulation; steps end at whole multiples of it on the clock.
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
        """Let snapshots cover a participant. ``snapshot()`` returns what puts it back, given how many nanoseconds later
        it is then."""
        self._kept.append(snapshot)

    def snapshot(self) -> Restore:
        """All participants as they are now. Putting them back leaves the clock alone: what they had before them then
        begins anew."""
        t_ns = self.advance()
        parts = [snapshot() for snapshot in self._kept]

        def restore() -> None:
            later_ns = self.advance() - t_ns
            for part in parts:
                part(later_ns)

        return restore

    def advance(self) -> int:
        """Make all steps up to the clock's now; returns ``t_ns``. Within a step it does nothing."""
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
