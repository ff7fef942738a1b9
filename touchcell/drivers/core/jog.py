"""Jog input: what an operator who moves an arm by hand asks for, and the Protocols of what reports it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol, TypeAlias, runtime_checkable

from touchcell.drivers.core.samples import Stamped
from touchcell.registry import Registry

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


class JogButton(Enum):
    """What a button of an input device changes or asks for."""

    FRAME = "frame"
    """Base, tool, contact, and from the beginning."""
    STEPS = "steps"
    UNTIL_TOUCH = "until touch"
    NEXT_ARM = "next arm"
    MORE = "more"
    """Faster, or longer steps ..."""
    LESS = "less"
    """... and the other way."""
    STOP = "stop at once"


@dataclass(frozen=True, slots=True)
class HandState:
    """What an input device reports now.

    Attributes:
        held: whether its dead-man control is pressed; without it nothing moves.
        axes: deflection, along x, y and z of the chosen frame.
        retract: whether a withdrawal is asked for.
        pressed: buttons that went down since the last call.
    """

    held: bool
    axes: Axes = AT_REST
    retract: bool = False
    pressed: tuple[JogButton, ...] = ()


@runtime_checkable
class HandDevice(Protocol):
    """Input device that a hand holds: a gamepad, a SpaceMouse. It is read in a process of its own, never in a run's."""

    def read(self) -> HandState:
        """Return what is held now; never blocks.

        Raises:
            DeviceError: it cannot be read any more.
        """
        ...

    def close(self) -> None:
        """Give it back."""
        ...


@dataclass(frozen=True, slots=True)
class HandDeviceSpec:
    """What an entry point of the group ``touchcell.hand_devices`` leads to.

    Attributes:
        name: as in ``touchcell jog --input NAME``.
        summary: one line for ``touchcell list``.
        connect: opens the first such device; raises ConnectError without one, or without its library.
        extra: of touchcell that has its library; empty for none.
    """

    name: str
    summary: str
    connect: Callable[[], HandDevice]
    extra: str = ""


HAND_DEVICES: Final = Registry("touchcell.hand_devices", "input device", HandDeviceSpec)
