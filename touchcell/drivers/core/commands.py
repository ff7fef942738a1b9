"""Motion commands, each with its reference frame and time-to-live."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final, Generic, TypeVar

import numpy as np

from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.geometry.types import Array

C = TypeVar("C")


class TwistFrame(Enum):
    """Axes in which both vectors of a twist are expressed. Its reference point is always the tool centre point."""

    TCP = "tcp"
    BASE = "base"


def read_only(array: Array) -> Array:
    """A copy of ``array`` that cannot be written to, nor be made writeable."""
    copy: Array = np.frombuffer(array.tobytes(), array.dtype)
    return copy if array.ndim == 1 else copy.reshape(array.shape)


def is_immutable(array: Array) -> bool:
    """Whether ``array`` lies in memory that nothing can change, as the copies of ``read_only`` of one dimension do."""
    return isinstance(array.base, bytes)


@dataclass(frozen=True, slots=True)
class TwistCommand:
    """Move the tool centre point at a velocity for at most ``ttl_s``, then stop.

    A command is a value: it keeps a read-only copy of an array of numbers, so that nothing that sees it on its way to
    the arm can change it. Anything else is left unchanged, for the gate to reject.

    Attributes:
        twist: (6,) [vx vy vz wx wy wz], m/s and rad/s: linear velocity of the tool centre point, angular velocity.
        frame: axes in which ``twist`` is expressed.
        t_ns: time at which the command was computed; it expires at ``t_ns + ttl_s``.
        ttl_s: time-to-live: how long the arm may follow it without a newer command.
        t_cause_ns: capture time of the sample that caused it, so that the sensor-to-command latency is measurable.
    """

    twist: Array
    frame: TwistFrame
    t_ns: int
    ttl_s: float
    t_cause_ns: int | None = None

    def __post_init__(self) -> None:
        twist = self.twist
        if type(twist) is np.ndarray and not is_immutable(twist) and twist.dtype == _FLOAT64 and twist.flags.writeable:
            object.__setattr__(self, "twist", read_only(twist))


@dataclass(frozen=True, slots=True)
class Sent(Generic[C]):
    """The command actually sent, and why it differs from the request. Read-only like the command."""

    command: C
    t_ns: int
    adjustments: tuple[Adjustment, ...] = ()

    @property
    def limited(self) -> bool:
        """True if a limit changed the command."""
        return bool(self.adjustments)


def in_base_axes(command: TwistCommand, T_base_tcp: Array) -> Array:
    """Return the command's twist along base axes, (6,), rotated by the orientation of the tool where needed."""
    if command.frame is TwistFrame.BASE:
        return command.twist
    # Both vectors at once.
    turned: Array = (command.twist.reshape(2, 3) @ T_base_tcp[:3, :3].T).ravel()
    return turned


_FLOAT64: Final = np.dtype(np.float64)
