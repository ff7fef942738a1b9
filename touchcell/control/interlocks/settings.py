"""Base classes of the interlocks' settings."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from touchcell.control.interlocks.violation import Severity


class InterlockSettings(BaseModel):
    """Base of the settings: unknown keys are refused, no limit has a default."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    severity: Literal["trip", "fault"] = "trip"

    @property
    def level(self) -> Severity:
        """The severity as the interlocks use it."""
        return Severity[self.severity.upper()]


class GradedSettings(InterlockSettings):
    """Settings of an interlock that may first slow the motion; a limit violation that lasts becomes a trip."""

    severity: Literal["limit", "trip", "fault"] = "trip"  # type: ignore[assignment]


LEAVE = 0.8
"""Hysteresis: default fraction of the limit to which a value must fall before it counts as below again."""
