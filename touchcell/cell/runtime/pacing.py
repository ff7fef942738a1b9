"""When the next control cycle is due."""

from __future__ import annotations

from touchcell.drivers.core.clock import Clock


class Pacing:
    """Keeps cycles on a grid of time.

    Args:
        clock: injected time.
        rate_hz: cycles per second.
    """

    def __init__(self, clock: Clock, rate_hz: float) -> None:
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self._due_ns = clock.now_ns()

    def restart(self) -> None:
        """Let the grid begin now."""
        self._due_ns = self._clock.now_ns()

    def wait(self) -> None:
        """Sleep until the next cycle is due; cycles that were missed are not made up for."""
        self._due_ns += self._period_ns
        now_ns = self._clock.now_ns()
        if now_ns - self._due_ns > self._period_ns:
            self._due_ns = now_ns
        self._clock.sleep_until_ns(self._due_ns)
