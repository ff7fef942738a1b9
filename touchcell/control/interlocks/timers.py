"""Interlocks with state: values that stay beyond a limit, conditions that last.

Such an interlock stores nothing itself. It is given the timer states of the previous cycle and returns new ones, so it
is a pure function like the others; the supervisor keeps the states of all interlocks in one place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.violation import Severity, Violation


@dataclass(frozen=True, slots=True)
class TimerState:
    """State that an interlock keeps for one arm or sensor.

    Attributes:
        since_ns: time at which the condition began.
        count: number of frames that have shown it.
        seq: the latest of them.
        values: reference values to compare with.
    """

    since_ns: int
    count: int = 1
    seq: int | None = None
    values: tuple[float, ...] = ()


InterlockState = Mapping[str, TimerState]
"""Timer states of one interlock, by the role of the arm or the sensor."""

NO_MARKS: Final[InterlockState] = MappingProxyType({})
"""Nothing to remember."""

Judgement = tuple[Violation | None, InterlockState]
"""The worst violation, or None, and the timer states for the next cycle."""


@runtime_checkable
class TimedInterlock(Protocol):
    """An interlock with state. ``evaluate`` is a pure function; an exception in it counts as a fault."""

    @property
    def name(self) -> str:
        """Its name in the cell file."""
        ...

    @property
    def severity(self) -> Severity:
        """Severity of its violations."""
        ...

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return the violation in ``view``, if any, and the new state, given that of the previous cycle."""
        ...


@runtime_checkable
class Levelled(Protocol):
    """An interlock whose quantities can be watched."""

    def levels(self, view: CellView, past: InterlockState) -> Iterable[Level]:
        """Return the quantities in ``view``, given the timer states after it was evaluated."""
        ...


@dataclass(frozen=True, slots=True)
class Reading:
    """A number measured on one arm or sensor in this cycle, and the number of the frame that it comes from."""

    subject: str
    value: float
    seq: int | None = None


@dataclass(frozen=True, slots=True)
class Sustained:
    """Limit how long a value may exceed its limit, with hysteresis.

    Once above ``limit`` it counts as above until it is at or below ``leave``.

    Attributes:
        measure: returns the readings of a cycle; the state of a subject without one is dropped.
        what: text in front of the value.
        limit, leave: in ``unit``.
        hold_s: time for which it may be above.
        frames: number of frames above the limit that make a violation; readings without a frame count once.
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
        """Return a violation for the first subject that is above for too long."""
        return self.over(view, self.measure(view), past)

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield the readings beside the limit."""
        for reading in self.measure(view):
            yield Level(reading.subject, reading.value, self.limit, self.unit)

    def over(self, view: CellView, readings: Iterable[Reading], past: InterlockState) -> Judgement:
        """Evaluate readings that the caller has taken."""
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
    """Several interlocks under one name; the first violated one counts."""

    name: str
    severity: Severity
    rules: tuple[TimedInterlock, ...]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return the first violation of its interlocks."""
        marks: dict[str, TimerState] = {}
        found: Violation | None = None
        for k, rule in enumerate(self.rules):
            violation, left = rule.evaluate(view, select_state(past, k))
            marks.update(number_state(left, k))
            found = found or violation
        return found, marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield the quantities of each of its interlocks."""
        for k, rule in enumerate(self.rules):
            if isinstance(rule, Levelled):
                yield from rule.levels(view, select_state(past, k))


def select_state(past: InterlockState, number: int) -> InterlockState:
    """Return the state of interlock ``number`` of several under one name."""
    prefix = f"{number}:"
    return {key.removeprefix(prefix): mark for key, mark in past.items() if key.startswith(prefix)}


def number_state(marks: InterlockState, number: int) -> InterlockState:
    """Return the state of interlock ``number`` with keys that keep it apart from the others' under one name."""
    return {f"{number}:{key}": mark for key, mark in marks.items()}


@dataclass(frozen=True, slots=True)
class OnDelay:
    """On-delay timer (IEC 61131-3 TON): limit how long a condition may last.

    Attributes:
        condition: returns a description of the condition for each subject that it applies to in this cycle.
        limit_s: longest allowed duration.
    """

    name: str
    severity: Severity
    condition: Callable[[CellView], Mapping[str, str]]
    limit_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the subject with the longest duration, if too long."""
        matters = self.condition(view)
        marks = {subject: past.get(subject, TimerState(view.now_ns)) for subject in matters}
        return overdue(self.name, self.severity, view, marks, self.limit_s, lambda s: matters[s]), marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield for how long the condition has lasted, where it does."""
        yield from waited(view, past, self.limit_s)


def waited(view: CellView, past: InterlockState, limit_s: float) -> Iterator[Level]:
    """Yield for how long each condition has lasted."""
    for subject, mark in past.items():
        yield Level(subject, 1e-6 * (view.now_ns - mark.since_ns), 1e3 * limit_s, "ms")


def overdue(
    name: str, severity: Severity, view: CellView, marks: InterlockState, limit_s: float, describe: Callable[[str], str]
) -> Violation | None:
    """Return a violation for the oldest state if older than ``limit_s``; ``describe`` gives the condition's text."""
    subject = min(marks, key=lambda s: marks[s].since_ns, default=None)
    if subject is None:
        return None
    lasted_ns = view.now_ns - marks[subject].since_ns
    if lasted_ns <= round(1e9 * limit_s):
        return None
    lasted_s = 1e-9 * lasted_ns
    reason = f"{describe(subject)} for {1e3 * lasted_s:.0f} ms, limit {1e3 * limit_s:g} ms"
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
