"""What devices can do, as small Protocols. A task asks for protocols, never for a driver by name."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from typing import Final, Protocol, runtime_checkable

from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.samples import Frame, JointState, Stamped, TcpState
from touchcell.drivers.kinematics.chain import DifferentialIk
from touchcell.geometry.types import Array


class StopCategory(IntEnum):
    """Stop categories of IEC 60204-1. A software stop is never an emergency stop."""

    REMOVE_POWER = 0
    STOP_THEN_REMOVE_POWER = 1
    STOP_AND_HOLD = 2


@runtime_checkable
class TcpSource(Protocol):
    """Tells where the tool centre point is."""

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Newest state. Raises StaleData if it is older than ``max_age_s``."""
        ...


@runtime_checkable
class JointSource(Protocol):
    """Tells its joint angles."""

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Newest state. Raises StaleData if it is older than ``max_age_s``."""
        ...


@runtime_checkable
class WrenchSource(Protocol):
    """Measures the wrench on the tool."""

    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """(6,) [force N, torque N m] on the tool centre point along base axes. Raises StaleData."""
        ...


@runtime_checkable
class TwistSink(Protocol):
    """Moves by twists that expire."""

    def acquire(self, owner: str) -> Lease:
        """Take the command lease. Raises CommandRejected(LEASE) while another holds it."""
        ...

    def release(self, lease: Lease) -> None:
        """Stop and give the lease back."""
        ...

    def send_twist(self, command: TwistCommand, lease: Lease) -> Sent[TwistCommand]:
        """Follow ``command`` until it expires. Never blocks for more than a period. Raises CommandRejected."""
        ...


@runtime_checkable
class Stoppable(Protocol):
    """Comes to rest when told; needs no lease."""

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        """Begin to stop at once and drop every setpoint. Raises LifecycleError for a category it does not offer."""
        ...

    def at_rest(self) -> bool:
        """Whether it stands still now."""
        ...


class ServoArm(TcpSource, TwistSink, Stoppable, Protocol):
    """What a run loop needs of an arm that it moves, in this process or in another."""

    name: str

    @property
    def limits(self) -> TwistLimits:
        """What its gate allows."""
        ...

    @property
    def stop_categories(self) -> frozenset[StopCategory]:
        """Stop categories that it offers in software."""
        ...

    def kinematics(self) -> DifferentialIk | None:
        """Of its joints, for an arm that tells them and whose chain is known; None for others."""
        ...


@runtime_checkable
class JointGoal(Protocol):
    """Goes to joint angles by its own planner."""

    def go_to_joints(self, q: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving to ``q`` (n,) rad. Raises CommandRejected. ``at_rest`` tells when it has arrived."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """Delivers camera frames, stamped at capture."""

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Newest frame. Raises StaleData if it is older than ``max_age_s``."""
        ...

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """First available frame with ``seq > after_seq``. Raises TransportTimeout, EndOfStream, DeviceGone."""
        ...


@runtime_checkable
class HealthSource(Protocol):
    """Tells how it feels, as named numbers and words for people and interlocks."""

    def health(self) -> dict[str, float | int | str | bool]:
        """Named readings, e.g. dropped frames, temperatures, mode."""
        ...


@runtime_checkable
class NativeWatchdog(Protocol):
    """Stops by itself when the host falls silent."""

    def watchdog_s(self) -> float:
        """Period after which silence stops it, read back from the device."""
        ...


SERVO_ARM: Final[frozenset[type]] = frozenset({TcpSource, TwistSink, Stoppable})
"""What a task needs of an arm that it moves; see ``ServoArm``."""


def protocol_names(protocols: Iterable[type]) -> str:
    """Names of ``protocols`` for messages, sorted and separated by commas."""
    return ", ".join(sorted(protocol.__name__ for protocol in protocols))


def require_protocols(protocols: Iterable[object]) -> None:
    """Check a declaration. Raises TypeError for anything that ``isinstance`` cannot hold against a device."""
    for each in protocols:
        if not (isinstance(each, type) and getattr(each, "_is_runtime_protocol", False)):
            raise TypeError(f"{each!r} is no runtime-checkable Protocol class")
