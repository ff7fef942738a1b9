"""Interlock on the readings of devices that are neither arms nor tactile sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import PositiveFloat

from touchcell.control.interlocks.coverage import SILENCE_S, CannotTrip, CellFacts, Change, Fault, with_reading
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
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
