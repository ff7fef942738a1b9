"""What a run loop reports: after each cycle to a display, and at the end of the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from touchcell.cell.runtime.stopping import StopReport
from touchcell.cell.runtime.timing import CycleTimes
from touchcell.control.interlocks.violation import Violation
from touchcell.control.latch import ResetDone
from touchcell.errors import TouchcellError
from touchcell.perception.runtime.estimate import ContactEstimate


class Outcome(Enum):
    """How a run ended."""

    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Progress:
    """What a live display may show after a cycle."""

    t_s: float
    state: str
    contacts: Mapping[str, ContactEstimate]
    telemetry: Mapping[str, float]
    waiting: str = ""
    """What the operator has to know while the run waits for a reset; empty while it runs."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended and how long its cycles took.

    Attributes:
        outcome: a single term.
        reason: in one sentence; empty when the task simply finished.
        state: the task's last state.
        duration_s: cell time from start to end.
        cycles: control cycles.
        times: duration of each stage of each cycle.
        error: what was raised, where something was.
        causes: what the supervisor latched, the first cause first.
        stops: how each arm came to rest.
        resets: what was cleared on the way, and by whom, where the run waited for that.
        rests_on: what nothing has measured and the outcome rests on, each in a phrase that continues "done, as far as".
        lost: whether a device or a process was lost, by which the run ended.
    """

    outcome: Outcome
    reason: str
    state: str
    duration_s: float
    cycles: int
    times: CycleTimes
    error: TouchcellError | None = None
    causes: tuple[Violation, ...] = ()
    stops: Mapping[str, StopReport] = field(default_factory=dict)
    resets: tuple[ResetDone, ...] = ()
    rests_on: tuple[str, ...] = ()
    lost: bool = False
