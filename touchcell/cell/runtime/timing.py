"""How long the stages of control cycles take: for the recording, cycle by cycle, and for a run's summary."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

MOST_KEPT = 100_000
"""Durations of one stage beyond which the older half is let go, so that a long run takes no more memory.

A cell at 100 Hz keeps 8 to 17 minutes.
"""


@dataclass(slots=True)
class CycleTimes:
    """Durations of the stages, nanoseconds.

    Attributes:
        rows: by stage, oldest first, of as many cycles as are kept.
    """

    rows: dict[str, array[int]] = field(default_factory=dict)
    _cycle: dict[str, int] = field(default_factory=dict)

    def begin(self) -> None:
        """A new cycle begins."""
        self._cycle.clear()

    def add(self, stage: str, duration_ns: int) -> None:
        """Append one duration; a stage that runs several times in a cycle, for several sensors, counts each time."""
        row = self.rows.get(stage)
        if row is None:
            row = self.rows[stage] = array("q")
        if len(row) >= MOST_KEPT:
            del row[: MOST_KEPT // 2]
        row.append(duration_ns)
        self._cycle[stage] = self._cycle.get(stage, 0) + duration_ns

    def message(self) -> dict[str, int]:
        """This cycle's stages as they are recorded: ``STAGE_us``, whole microseconds."""
        return {f"{stage.replace(' ', '_')}_us": round(1e-3 * duration) for stage, duration in self._cycle.items()}
