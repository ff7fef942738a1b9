"""An asyncio loop on the time of an emulated world."""

from __future__ import annotations

import asyncio
import selectors

from touchcell.drivers.core.paced_clock import emulated_clock, emulated_pace


class _PacedSelector(selectors.DefaultSelector):
    """Selector whose timeouts are in seconds of the emulated world."""

    def __init__(self, pace: float) -> None:
        super().__init__()
        self._pace = pace

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        return super().select(timeout if timeout is None else timeout / self._pace)


class PacedLoop(asyncio.SelectorEventLoop):
    """Event loop whose ``time``, sleeps and timers are those of the emulated world that this process belongs to."""

    def __init__(self) -> None:
        self._clock = emulated_clock()
        super().__init__(_PacedSelector(emulated_pace()))

    def time(self) -> float:
        return 1e-9 * self._clock.now_ns()
