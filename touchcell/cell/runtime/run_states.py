"""The states of a run, as a table that is checked, drawn and walked like that of a task."""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from touchcell.tasks.state_machine import FAULT, STOP, TRIP, StateDef, Table, TransitionDef

STARTED: Final = "started"
"""The first frames are there, the leases taken, the watchdog guards."""
FINISHED: Final = "finished"
"""The task has reached a terminal state."""
STOPPED: Final = "stopped"
"""Every arm has been watched until it stood, or until its driver had no further means."""
RESUME: Final = "resume"
"""The operator lets the task start again."""
TIMEOUT: Final = "timeout"
"""A state has lasted too long."""

_START_TIMEOUT_S: Final = 600.0
_STOP_TIMEOUT_S: Final = 600.0
_WAIT_TIMEOUT_S: Final = 7 * 24 * 3600.0


class RunState(Enum):
    """Where a run is."""

    STARTING = auto()
    RUNNING = auto()
    STOPPING = auto()
    WAITING_FOR_RESET = auto()
    ENDED = auto()


def run_table(max_duration_s: float) -> Table:
    """The states of a run whose task may take ``max_duration_s`` from each start to its end.

    All ways out of motion lead through STOPPING, on whose entry all arms are commanded to stop, and out of STOPPING
    only ``stopped`` leads. Nothing but ``resume`` leads from a trip back to motion, and only while the latch is clear.
    """
    s = RunState
    return Table(
        task="run",
        states=(
            StateDef(s.STARTING, _START_TIMEOUT_S, TIMEOUT),
            StateDef(s.RUNNING, max_duration_s, TIMEOUT, on_enter="enter_running"),
            StateDef(s.STOPPING, _STOP_TIMEOUT_S, TIMEOUT, on_enter="enter_stopping"),
            StateDef(s.WAITING_FOR_RESET, _WAIT_TIMEOUT_S, TIMEOUT, on_enter="enter_waiting"),
            StateDef(s.ENDED, terminal=True),
        ),
        transitions=(
            TransitionDef(STARTED, s.STARTING, s.RUNNING),
            TransitionDef(FINISHED, s.RUNNING, s.STOPPING),
            TransitionDef(STOPPED, s.STOPPING, s.WAITING_FOR_RESET, guard="waits_for_reset"),
            TransitionDef(STOPPED, s.STOPPING, s.ENDED),
            TransitionDef(RESUME, s.WAITING_FOR_RESET, s.RUNNING, guard="latch_is_clear"),
            TransitionDef(TIMEOUT, None, s.STOPPING),
            TransitionDef(STOP, None, s.STOPPING),
            TransitionDef(TRIP, None, s.STOPPING),
            TransitionDef(FAULT, None, s.STOPPING),
        ),
    )
