"""An operator who moves an arm by hand as a script says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from touchcell.drivers.core.jog import JogFrame, JogMode, JogRequest
from touchcell.drivers.core.samples import Stamped


@dataclass(frozen=True, slots=True)
class Held:
    """A request that is held from one time to another, in seconds since the first cycle."""

    from_s: float
    to_s: float
    request: JogRequest


class ScriptedJog:
    """Jog input that holds each request of a script, and keeps the stamp of the last one afterwards.

    Args:
        script: in order of time.
        dies_s: when its process is killed: nothing is stamped any more.
    """

    def __init__(self, script: Sequence[Held], dies_s: float = float("inf")) -> None:
        self._script = script
        self._dies_s = dies_s
        self._start_ns: int | None = None
        self._newest: Stamped[JogRequest] | None = None

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        if self._start_ns is None:
            self._start_ns = now_ns
        t_s = (now_ns - self._start_ns) * 1e-9
        if t_s < self._dies_s:
            for seq, held in enumerate(self._script):
                if held.from_s <= t_s < held.to_s:
                    self._newest = Stamped(held.request, now_ns, seq)
        return self._newest


def every_state(arm: str = "arm") -> list[Held]:
    """A script that leads through every state: a free motion, a step, a guarded motion, a withdrawal."""
    down = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return [
        Held(0.6, 0.9, JogRequest(arm, JogMode.FREE, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), share=0.4)),
        Held(1.2, 1.5, JogRequest(arm, JogMode.STEP, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0), step_m=0.002)),
        Held(1.8, 3.4, JogRequest(arm, JogMode.UNTIL_TOUCH, down, JogFrame.TOOL)),
        Held(3.7, 4.5, JogRequest(arm, JogMode.RETRACT, share=0.2)),
    ]
