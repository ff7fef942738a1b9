"""The proof that an interlock can trip: its faults, put before the real interlock, supervisor and latch.

See docs/explanation/armed-coverage.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from itertools import count
from typing import Any

from touchcell.control.interlocks.coverage import CannotTrip, CellFacts, Fault, Provable
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.interlocks.violation import Violation
from touchcell.control.latch import unlogged_latch
from touchcell.control.supervisor import LIMIT_FOR_NS, Supervisor

_Healthy = Callable[[int, str], CellView]

_START_NS = 10**12
_HEALTHY_CYCLES = 2


class _Watched(CellView):
    """A snapshot that notes in ``asked`` for which states of the task it was asked."""

    __slots__ = ("asked",)

    asked: set[str]

    @classmethod
    def of(cls, view: CellView, asked: set[str]) -> _Watched:
        watched = cls(**{each.name: getattr(view, each.name) for each in fields(view)})
        object.__setattr__(watched, "asked", asked)
        return watched

    def __getattribute__(self, name: str) -> Any:
        value = super().__getattribute__(name)
        # What an interlock derives from it with `replace` has no notes: deriving it has asked already.
        if name == "task_state" and hasattr(self, "asked"):
            self.asked.add(value)
        return value


@dataclass(frozen=True, slots=True)
class Proof:
    """Result for one arm or sensor that an interlock guards.

    Attributes:
        interlock: its name in the cell file.
        kind: of the interlock.
        subject: role of the arm or sensor concerned; empty for all.
        fault: the fault that it was shown; empty if there is none.
        limit: that the fault exceeds, with its unit.
        tripped_s: longest time to the trip, over the states of the task; None if it did not trip.
        covers: roles that are guarded by it.
        states: in which it counts; empty for all.
        problem: why it cannot trip; empty if it can.
        key, hint: of the cell file, below the interlock; and the remedy.
        fatal: False if the cell need not be refused for the problem.
    """

    interlock: str
    kind: str
    subject: str
    fault: str = ""
    limit: str = ""
    tripped_s: float | None = None
    covers: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    problem: str = ""
    key: str = ""
    hint: str = ""
    fatal: bool = True


def prove(
    name: str, settings: InterlockSettings, interlock: Interlock | TimedInterlock, facts: CellFacts
) -> tuple[Proof, ...]:
    """Show an interlock the faults that must trip it; returns a result for each.

    Args:
        name: of the interlock in the cell file.
        settings: that it was built from.
        interlock: the built one.
        facts: what the cell can show it.
    """
    if not isinstance(settings, Provable):
        return (Proof(name, settings.kind, "", problem="not proven: it describes no faults", fatal=False),)
    try:
        cases = tuple(settings.faults(facts))
    except Exception as error:
        return (Proof(name, settings.kind, "", problem=f"its faults cannot be described: {error!r}"),)
    if not cases:
        return (Proof(name, settings.kind, "", problem="it guards nothing in this cell", key="kind"),)
    healthy = cache(facts.healthy)
    return tuple(_proof(name, settings.kind, case, interlock, facts, healthy) for case in cases)


def _proof(
    name: str,
    kind: str,
    case: Fault | CannotTrip,
    interlock: Interlock | TimedInterlock,
    facts: CellFacts,
    healthy: _Healthy,
) -> Proof:
    if isinstance(case, CannotTrip):
        return Proof(name, kind, case.subject, problem=case.reason, key=case.key, hint=case.hint, fatal=case.fatal)
    slowest_s = 0.0
    problem = ""
    asked: set[str] = set()
    for state in case.states or facts.states or ("",):
        tripped_s, problem = _shown(name, case, interlock, facts.period_s, healthy, state, asked)
        if tripped_s is None:
            break
        slowest_s = max(slowest_s, tripped_s)
        if not (asked or case.states):
            # The same fault before an interlock that has not asked for the state ends the same way in all of them.
            break
    return Proof(
        name,
        kind,
        case.subject,
        case.what,
        case.limit,
        None if problem else slowest_s,
        case.covers or (case.subject,),
        case.states,
        problem,
        case.key,
        case.hint if problem else "",
    )


def _shown(
    name: str,
    fault: Fault,
    interlock: Interlock | TimedInterlock,
    period_s: float,
    healthy: _Healthy,
    state: str,
    asked: set[str],
) -> tuple[float | None, str]:
    """Return the time from the fault to the trip in one state of the task, and why there was none.

    The state is added to ``asked`` if the interlock asks for it.
    """
    latch = unlogged_latch()
    supervisor = Supervisor([interlock], latch)
    period_ns = max(1, round(1e9 * period_s))
    before = max(_HEALTHY_CYCLES, -int(-1e9 * fault.before_s // period_ns))
    # An interlock that first limits trips later by that long.
    last_s = fault.within_s + 1e-9 * LIMIT_FOR_NS + 2e-9 * period_ns
    for k in count(-before):
        t_s = 1e-9 * k * period_ns
        if t_s > last_s:
            return None, f"{fault.what}: does not trip within {fault.within_s:g} s{_in(state)}"
        view = healthy(_START_NS + k * period_ns, state)
        try:
            view = (fault.before if k < 0 else fault.change)(view, t_s)
        except Exception as error:
            return None, f"{fault.what}: cannot be shown{_in(state)}: {error!r}"
        supervisor.review(_Watched.of(view, asked))
        causes = latch.causes
        if not causes:
            continue
        if k < 0:
            return None, f"trips without a fault{_in(state)}: {_said(causes)}"
        if causes[0].interlock != name:
            return None, f"{fault.what}: something else trips{_in(state)}: {_said(causes)}"
        if causes[0].raised and not fault.by_error:
            return None, f"{fault.what}: it raises in place of comparing its limit{_in(state)}: {causes[0].reason}"
        return t_s, ""
    raise AssertionError("unreachable")


def _in(state: str) -> str:
    return f" in {state}" if state else ""


def _said(causes: Sequence[Violation]) -> str:
    return f"{causes[0].interlock}: {causes[0].reason}"
