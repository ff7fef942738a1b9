"""What the settings of all interlocks have in common."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from touchcell.control.interlocks.violation import Severity


class InterlockSettings(BaseModel):
    """Base of the settings: unknown keys refused, no limit has a default."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    severity: Literal["trip", "fault"] = "trip"

    @property
    def level(self) -> Severity:
        """The severity as the rules use it."""
        return Severity[self.severity.upper()]


class GradedSettings(InterlockSettings):
    """Settings of a rule that may also ask for slower motion first; a limit that lasts becomes a trip."""

    severity: Literal["limit", "trip", "fault"] = "trip"  # type: ignore[assignment]


LEAVE = 0.8
"""Once above its limit, a value counts as above until it has fallen to this share of it, unless the file says more."""
