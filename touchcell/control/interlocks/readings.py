"""Interlocks on readings: their age, and what a device reports about itself, such as temperatures and voltages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from touchcell.control.interlocks.coverage import (
    SILENCE_S,
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    role_problem,
    with_health,
    with_reading,
)
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import InterlockState, Judgement, TimedInterlock, TimerState
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class ReadingAge:
    """Limit the age of every device's newest reading; a time stamp in the future is a violation too."""

    name: str
    severity: Severity
    limit_s: float

    def check(self, view: CellView) -> Violation | None:
        for role, device in view.devices.items():
            if device.reading is None:
                continue
            age_s = (view.now_ns - device.reading.t_ns) * 1e-9
            if not 0.0 <= age_s <= self.limit_s:
                reason = f"newest reading is {1e3 * age_s:.1f} ms old, limit {1e3 * self.limit_s:g} ms"
                return Violation(
                    self.name, self.severity, role, reason, view.now_ns, value=age_s, limit=self.limit_s, unit="s"
                )
        return None


class ReadingAgeConfig(InterlockSettings):
    """Largest age of the reading of any device under ``devices:``.

    Attributes:
        limit_ms: oldest reading that is accepted.
    """

    kind: Literal["reading_age"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each device that is read and falls silent."""
        if not facts.devices:
            yield CannotTrip("", "no other device is read", "kind", "leave it out")
        for role in facts.devices:
            limit, hint = f"{self.limit_ms:g} ms", f"lower it below {1e3 * SILENCE_S:g} ms"
            yield Fault(role, "silent", limit, _silent(role), within_s=SILENCE_S, key="limit_ms", hint=hint)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """Return the ``ReadingAge`` interlock."""
        return ReadingAge(name, self.level, 1e-3 * self.limit_ms)


def _silent(role: str) -> Change:
    return lambda view, t_s: with_reading(view, role, t_s)


READING_AGE = InterlockSpec("reading_age", "readings of other devices are fresh", ReadingAgeConfig)

OLDEST_HEALTH_S: Final = 3.0
"""Age of a device's health from which a limit on it is violated: it is read twice a second."""
_STEP: Final = 0.02
_SINCE: Final = ""


@dataclass(frozen=True, slots=True)
class ReadingLimit:
    """Limit one number that a device reports about itself; missing for three seconds or too old is a violation too.

    Attributes:
        name: of the entry in the cell file.
        severity: of a violation.
        device: name of the device in the cell file.
        reading: name of the number in its health; a boolean counts as 0 or 1.
        most, least: largest and smallest value allowed, in the unit of the name.
    """

    name: str
    severity: Severity
    device: str
    reading: str
    most: float | None
    least: float | None

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return the violation, if any, and since when the reading has been awaited."""
        sample = view.health.get(self.device)
        value = None if sample is None else sample.value.get(self.reading)
        if sample is None or value is None:
            state = past or {_SINCE: TimerState(view.now_ns)}
            awaited_s = (view.now_ns - state[_SINCE].since_ns) * 1e-9
            reason = f"reports no {self.reading!r}"
            return (None if awaited_s <= OLDEST_HEALTH_S else self._violation(view, reason)), state
        age_s = sample.age_s(view.now_ns)
        if not 0.0 <= age_s <= OLDEST_HEALTH_S:
            return self._violation(view, f"last reported its health {age_s:.1f} s ago"), {}
        if isinstance(value, str):
            return self._violation(view, f"{self.reading} is {value!r}, not a number"), {}
        # Written so that NaN is a violation.
        if self.most is not None and not value <= self.most:
            return self._violation(view, f"{self.reading} is {value:.6g}, most {self.most:g}", value, self.most), {}
        if self.least is not None and not value >= self.least:
            return self._violation(view, f"{self.reading} is {value:.6g}, least {self.least:g}", value, self.least), {}
        return None, {}

    def _violation(
        self, view: CellView, reason: str, value: float | None = None, limit: float | None = None
    ) -> Violation:
        return Violation(self.name, self.severity, self.device, reason, view.now_ns, value=value, limit=limit)


class ReadingConfig(InterlockSettings):
    """Limit of one number that a device reports about itself; ``touchcell probe`` prints their names.

    Attributes:
        device: name of an arm, a sensor or another device of the cell file.
        name: of the number, such as ``max_joint_temperature_c``, ``robot_voltage_v`` or ``frame_rate_hz``.
        limit: largest value allowed, in the unit of the name.
        least: smallest value allowed.
    """

    kind: Literal["reading"]
    device: str = Field(min_length=1)
    name: str = Field(min_length=1)
    limit: float | None = None
    least: float | None = None

    @model_validator(mode="after")
    def _limits_something(self) -> Self:
        if self.limit is None and self.least is None:
            raise ValueError("gives neither limit (largest value) nor least (smallest value)")
        if self.limit is not None and self.least is not None and self.least >= self.limit:
            raise ValueError(f"least {self.least:g} is not below limit {self.limit:g}")
        return self

    @property
    def reads(self) -> frozenset[tuple[str, str]]:
        """The reading that is limited."""
        return frozenset({(self.device, self.name)})

    @property
    def bounds(self) -> tuple[float | None, float | None]:
        """Smallest and largest value allowed."""
        return self.least, self.limit

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return the reading just beyond each limit, and a device that no longer reports."""
        problem = role_problem(self.device, facts.health, "device that reports its health and is called", "device")
        if problem is not None:
            yield problem
            return
        for key, bound, step in (("limit", self.limit, 1.0), ("least", self.least, -1.0)):
            if bound is not None:
                beyond = bound + step * max(_STEP * abs(bound), _STEP)
                change = _reads(self.device, self.name, beyond)
                yield Fault(self.device, f"{self.name} {beyond:.6g}", f"{bound:g}", change, within_s=0.0, key=key)
        yield Fault(self.device, "reports nothing", f"{OLDEST_HEALTH_S:g} s", _mute(self.device), within_s=4.0)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``ReadingLimit`` interlock."""
        return ReadingLimit(name, self.level, self.device, self.name, self.limit, self.least)


def _reads(device: str, name: str, value: float) -> Change:
    return lambda view, t_s: with_health(view, device, **{name: value})


def _mute(device: str) -> Change:
    return lambda view, t_s: with_health(view, device, t_s)


READING = InterlockSpec("reading", "a number that a device reports about itself stays within limits", ReadingConfig)
