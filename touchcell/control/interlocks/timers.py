"""Rules with a past: values that stay beyond a limit, conditions that last.

Such a rule remembers nothing itself. It is given the marks that it left in the cycle before and returns new ones, so it
is a pure function like the others; the supervisor keeps the marks of all rules in one place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.violation import Severity, Violation


@dataclass(frozen=True, slots=True)
class TimerState:
    """What a rule remembers of one arm or sensor.

    Attributes:
        since_ns: when it began.
        count: how many frames have shown it.
        seq: the latest of them.
        values: numbers to compare with.
    """

    since_ns: int
    count: int = 1
    seq: int | None = None
    values: tuple[float, ...] = ()


InterlockState = Mapping[str, TimerState]
"""The marks of one rule, by the role of the arm or the sensor."""

NO_MARKS: Final[InterlockState] = MappingProxyType({})
"""Nothing to remember."""

Judgement = tuple[Violation | None, InterlockState]
"""The worst violation, or None, and the marks for the next cycle."""


@runtime_checkable
class TimedInterlock(Protocol):
    """A rule with a past. ``judge`` is a pure function; what it raises counts as a fault."""

    @property
    def name(self) -> str:
        """Its name in the cell file."""
        ...

    @property
    def severity(self) -> Severity:
        """What a violation asks for."""
        ...

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The violation in ``view``, if any, given the marks of the cycle before."""
        ...


@dataclass(frozen=True, slots=True)
class Reading:
    """A number about one arm or sensor in this cycle, with the frame that it comes from."""

    subject: str
    value: float
    seq: int | None = None


@dataclass(frozen=True, slots=True)
class Sustained:
    """A value is not above its limit for longer than allowed.

    Once above ``limit`` it counts as above until it is at or below ``leave``.

    Attributes:
        measure: the readings of a cycle; a subject without one is forgotten.
        what: words in front of the value.
        limit, leave: in ``unit``.
        hold_s: how long it may be above.
        frames: how many frames it takes; a subject whose readings have no frame counts once.
    """

    name: str
    severity: Severity
    measure: Callable[[CellView], Iterable[Reading]]
    what: str
    limit: float
    leave: float
    unit: str
    hold_s: float = 0.0
    frames: int = 1

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The first subject that is above for too long."""
        return self.over(view, self.measure(view), past)

    def over(self, view: CellView, readings: Iterable[Reading], past: InterlockState) -> Judgement:
        """The same for readings that somebody else has taken."""
        marks: dict[str, TimerState] = {}
        found: Violation | None = None
        for reading in readings:
            mark = past.get(reading.subject)
            if not reading.value > (self.limit if mark is None else self.leave):
                continue
            if mark is None:
                mark = TimerState(view.now_ns, seq=reading.seq)
            elif reading.seq != mark.seq:
                mark = replace(mark, count=mark.count + 1, seq=reading.seq)
            marks[reading.subject] = mark
            lasted_ns = view.now_ns - mark.since_ns
            if found is None and lasted_ns >= round(1e9 * self.hold_s) and mark.count >= self.frames:
                found = self._violation(view, reading, 1e-9 * lasted_ns)
        return found, marks

    def _violation(self, view: CellView, reading: Reading, lasted_s: float) -> Violation:
        unit = f" {self.unit}" if self.unit else ""
        reason = f"{self.what} {reading.value:.4g}{unit}, limit {self.limit:g}{unit}"
        if lasted_s > 0.0:
            reason += f", for {1e3 * lasted_s:.0f} ms"
        return Violation(
            self.name,
            self.severity,
            reading.subject,
            reason,
            view.now_ns,
            value=reading.value,
            limit=self.limit,
            unit=self.unit,
            frame_seq=reading.seq,
        )


@dataclass(frozen=True, slots=True)
class AnyOf:
    """Several rules under one name: the first that is broken counts."""

    name: str
    severity: Severity
    rules: tuple[TimedInterlock, ...]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The violation of the first rule that has one."""
        marks: dict[str, TimerState] = {}
        found: Violation | None = None
        for k, rule in enumerate(self.rules):
            violation, left = rule.evaluate(view, share(past, k))
            marks.update(shared(left, k))
            found = found or violation
        return found, marks


def share(past: InterlockState, number: int) -> InterlockState:
    """The marks of the rule with that number, of several under one name."""
    prefix = f"{number}:"
    return {key.removeprefix(prefix): mark for key, mark in past.items() if key.startswith(prefix)}


def shared(marks: InterlockState, number: int) -> InterlockState:
    """``marks`` of the rule with that number, to be kept with those of others."""
    return {f"{number}:{key}": mark for key, mark in marks.items()}


@dataclass(frozen=True, slots=True)
class OnDelay:
    """A condition does not last longer than allowed.

    Attributes:
        condition: subject -> what is the matter with it, for those that it applies to in this cycle.
        limit_s: how long it may last.
    """

    name: str
    severity: Severity
    condition: Callable[[CellView], Mapping[str, str]]
    limit_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """The subject for which it has lasted longest, if too long."""
        matters = self.condition(view)
        marks = {subject: past.get(subject, TimerState(view.now_ns)) for subject in matters}
        return overdue(self.name, self.severity, view, marks, self.limit_s, lambda s: matters[s]), marks


def overdue(
    name: str, severity: Severity, view: CellView, marks: InterlockState, limit_s: float, words: Callable[[str], str]
) -> Violation | None:
    """A violation about the oldest mark if it is older than ``limit_s``; ``words`` say what is the matter with it."""
    subject = min(marks, key=lambda s: marks[s].since_ns, default=None)
    if subject is None:
        return None
    lasted_ns = view.now_ns - marks[subject].since_ns
    if lasted_ns <= round(1e9 * limit_s):
        return None
    lasted_s = 1e-9 * lasted_ns
    reason = f"{words(subject)} for {1e3 * lasted_s:.0f} ms, limit {1e3 * limit_s:g} ms"
    sensor = view.sensors.get(subject)
    return Violation(
        name,
        severity,
        subject,
        reason,
        view.now_ns,
        value=lasted_s,
        limit=limit_s,
        unit="s",
        frame_seq=None if sensor is None else sensor.seq,
    )
