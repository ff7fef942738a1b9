"""Enabling devices: what an operator holds while an arm may move (IEC 60947-5-8, ISO 10218-1:2025, 5.8.3).

A device read by this software is a hold-to-run control of the task, never the enabling function of a safety system:
that one is wired to the arm's own controller.
"""

from __future__ import annotations

from enum import Enum
from typing import Protocol, runtime_checkable

from touchcell.drivers.core.samples import Stamped


class EnablingPosition(Enum):
    """Positions of a three-position enabling device; only the middle one enables motion."""

    RELEASED = "released"
    ENABLED = "enabled"
    COMPRESSED = "compressed"


@runtime_checkable
class EnablingDevice(Protocol):
    """Operator input that reports the position of an enabling device."""

    def position(self) -> Stamped[EnablingPosition]:
        """Return the newest position, stamped when it was read. Raises DeviceError."""
        ...
