"""A simulated enabling device, for tests and for trying a cell without one."""

from __future__ import annotations

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.enabling import EnablingPosition
from touchcell.drivers.core.samples import Stamped


class SimulatedEnablingDevice:
    """Held in its middle position until it is set otherwise.

    Args:
        clock: injected time.

    Attributes:
        held: its position.
        silent: True while it does not report.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last_ns = clock.now_ns()
        self._seq = 0
        self.held = EnablingPosition.ENABLED
        self.silent = False

    def position(self) -> Stamped[EnablingPosition]:
        """Return the position now, or as it was when it fell silent."""
        if not self.silent:
            self._last_ns = self._clock.now_ns()
            self._seq += 1
        return Stamped(self.held, self._last_ns, self._seq)
