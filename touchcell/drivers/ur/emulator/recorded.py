"""A controller whose state is that of a recorded one: a capture of a network is played back to clients."""

from __future__ import annotations

from collections.abc import Mapping

from touchcell.drivers.ur.capture import Capture, RecordedState
from touchcell.drivers.ur.codec import Value
from touchcell.drivers.ur.emulator.controller import Controller
from touchcell.errors import ConfigError


class RecordedController(Controller):
    """Controller that reports what was recorded, at the pace at which it was; the last state for ever.

    It takes commands as the emulated one does, and they move nothing that it reports.

    Args:
        capture: recorded traffic.

    Raises:
        ConfigError: there is no state packet in it.
    """

    def __init__(self, capture: Capture) -> None:
        if not capture.states:
            raise ConfigError("the capture has no state packet", hint="record while a client reads the state")
        super().__init__()
        self._states = capture.states
        self._begin_s = capture.states[0].t_s
        self._at = 0

    def values(self) -> dict[str, Value]:
        """Return the recorded variables; those that were not recorded are the emulated ones."""
        played_s = self._begin_s + self.t_s
        while self._at + 1 < len(self._states) and self._states[self._at + 1].t_s <= played_s:
            self._at += 1
        return super().values() | dict(self._recorded(self._states[self._at]))

    def _recorded(self, state: RecordedState) -> Mapping[str, Value]:
        # Its clock goes on where the recording ends.
        return {**state.values, "timestamp": self.t_s}
