"""An interlock of a running cell that can be shown a fault, alone."""

from __future__ import annotations

from typing import Generic, TypeAlias, TypeVar

from touchcell.control.interlocks.coverage import CellFacts, Fault
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.timers import InterlockState, Judgement, TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation

RuleT = TypeVar("RuleT", bound=Interlock | TimedInterlock)


class _Shown(Generic[RuleT]):
    """What every interlock that can be shown a fault has in common.

    Args:
        rule: the cell's own interlock.
    """

    def __init__(self, rule: RuleT) -> None:
        self.rule = rule
        self._fault: Fault | None = None
        self._facts: CellFacts | None = None
        self._begun_ns = 0

    @property
    def name(self) -> str:
        """Its name in the cell file."""
        return self.rule.name

    @property
    def severity(self) -> Severity:
        """Severity of its violations."""
        return self.rule.severity

    def begin(self, fault: Fault, facts: CellFacts, now_ns: int) -> None:
        """Show it a healthy cell with ``fault`` from now on, behind what has to come before it."""
        self._fault, self._facts, self._begun_ns = fault, facts, now_ns

    def end(self) -> None:
        """Show it the cell as it is."""
        self._fault = None

    def _seen(self, view: CellView) -> CellView:
        fault = self._fault
        if fault is None or self._facts is None:
            return view
        view = self._facts.healthy(view.now_ns, view.task_state)
        t_s = 1e-9 * (view.now_ns - self._begun_ns) - fault.before_s
        return (fault.before if t_s < 0.0 else fault.change)(view, t_s)


class _ShownInterlock(_Shown[Interlock]):
    def check(self, view: CellView) -> Violation | None:
        """Judge the view that it is shown."""
        return self.rule.check(self._seen(view))


class _ShownTimedInterlock(_Shown[TimedInterlock]):
    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Judge the view that it is shown."""
        return self.rule.evaluate(self._seen(view), past)


Shown: TypeAlias = _ShownInterlock | _ShownTimedInterlock


def shown(rule: Interlock | TimedInterlock) -> Shown:
    """Return an interlock that judges as ``rule``, of the cell or of what it is shown."""
    return _ShownTimedInterlock(rule) if isinstance(rule, TimedInterlock) else _ShownInterlock(rule)
