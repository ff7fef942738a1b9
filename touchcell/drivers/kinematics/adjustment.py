"""Why a command was changed on its way to a device."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Adjustment:
    """One reason why what was sent is not what was asked for."""

    limit: str
    asked: float
    allowed: float
