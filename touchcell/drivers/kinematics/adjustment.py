"""Adjustments of a command on its way to a device."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Adjustment:
    """One limit that made the sent command differ from the requested one."""

    limit: str
    requested: float
    allowed: float
