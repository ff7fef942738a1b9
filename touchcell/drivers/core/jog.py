"""Jog input: what an operator who moves an arm by hand asks for, and the Protocol of what reports it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, TypeAlias, runtime_checkable

from touchcell.drivers.core.samples import Stamped

Axes: TypeAlias = tuple[float, float, float, float, float, float]
"""Deflection of x, y, z and of the rotations about them, each from -1 to 1."""

AT_REST: Axes = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class JogFrame(Enum):
    """Axes along which the arm is moved. Rotations are about the tool centre point, in CONTACT about the contact."""

    BASE = "base"
    TOOL = "tool"
    CONTACT = "contact"


class JogMode(Enum):
    """What a deflection does."""

    FREE = "free"
    """Move for as long as it is held."""
    STEP = "step"
    """Move by a step."""
    UNTIL_TOUCH = "until touch"
    """Move for as long as it is held, and stop at the first contact."""
    RETRACT = "retract"
    """Withdraw along the sensor's axis, or the tool's, for as long as it is held."""
    ZERO = "zero"
    """Move nothing: the sensors touch nothing now, and contacts are measured against this image."""


@dataclass(frozen=True, slots=True)
class JogRequest:
    """What is asked of one arm now.

    Attributes:
        arm: role of the arm.
        mode: what the deflection does.
        axes: deflection.
        frame: along whose axes.
        share: of the full speed, from 0 to 1.
        step_m: length of a step.
        step_rad: angle of a step.
    """

    arm: str
    mode: JogMode
    axes: Axes = AT_REST
    frame: JogFrame = JogFrame.BASE
    share: float = 1.0
    step_m: float = 0.0
    step_rad: float = 0.0


@runtime_checkable
class JogInput(Protocol):
    """Operator input that moves an arm by hand: a keyboard, a gamepad, a page."""

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        """Return the newest request, or None before the first. Never blocks, and never raises.

        It is stamped when the operator was last known to hold it: the dead-man function is the age of this stamp. Its
        sequence number rises with each new deflection, so that a step is done once.

        Args:
            now_ns: time of the control cycle.
        """
        ...
