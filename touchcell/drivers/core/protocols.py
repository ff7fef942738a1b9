"""Small Protocols of device capabilities. Tasks require protocols, never a driver by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.samples import Frame, JointState, Stamped, TcpState
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.drivers.kinematics.chain import DifferentialIk


class StopCategory(IntEnum):
    """Stop categories of IEC 60204-1. A software stop is never an emergency stop."""

    REMOVE_POWER = 0
    STOP_THEN_REMOVE_POWER = 1
    STOP_AND_HOLD = 2


@runtime_checkable
class TcpSource(Protocol):
    """Measures the pose and twist of the tool centre point."""

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the newest state. Raises StaleData if it is older than ``max_age_s``."""
        ...


@runtime_checkable
class JointSource(Protocol):
    """Measures joint angles."""

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return the newest state. Raises StaleData if it is older than ``max_age_s``."""
        ...


@runtime_checkable
class WrenchSource(Protocol):
    """Measures the wrench on the tool."""

    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (6,) [force N, torque N m] at the tool centre point along base axes. Raises StaleData."""
        ...


@runtime_checkable
class ExternalTorqueSource(Protocol):
    """Estimates the torque of contacts on its joints."""

    def external_torques(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (n,) N m of each joint, without gravity, friction and its own motion. Raises StaleData."""
        ...


@runtime_checkable
class TwistSink(Protocol):
    """Follows twists with a time-to-live."""

    def acquire(self, owner: str) -> Lease:
        """Take the command lease. Raises CommandRejected(LEASE) while another holds it."""
        ...

    def release(self, lease: Lease) -> None:
        """Stop and release the lease."""
        ...

    def send_twist(self, command: TwistCommand, lease: Lease) -> Sent[TwistCommand]:
        """Follow ``command`` until it expires. Never blocks for more than a period. Raises CommandRejected."""
        ...


@runtime_checkable
class Stoppable(Protocol):
    """Stops on request, without a lease."""

    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        """Begin to stop at once and discard every setpoint. Raises LifecycleError for an unsupported category."""
        ...

    def at_rest(self) -> bool:
        """Return whether the device is at standstill."""
        ...


class ServoArm(TcpSource, TwistSink, Stoppable, Protocol):
    """An arm that a run loop can move, in this process or in another."""

    name: str

    @property
    def limits(self) -> TwistLimits:
        """Limits that the command gate enforces."""
        ...

    @property
    def stop_categories(self) -> frozenset[StopCategory]:
        """Stop categories supported in software."""
        ...

    def kinematics(self) -> DifferentialIk | None:
        """Return the differential inverse kinematics, or None if joint angles or chain are unknown."""
        ...


@runtime_checkable
class JointGoal(Protocol):
    """Moves to joint angles by its own planner."""

    def go_to_joints(self, q: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving to ``q`` (n,) rad; ``at_rest`` reports arrival. Raises CommandRejected."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """Delivers camera frames, stamped at capture."""

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Return the newest frame. Raises StaleData if it is older than ``max_age_s``."""
        ...

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """Return the first frame with ``seq > after_seq``. Raises TransportTimeout, EndOfStream, DeviceGone."""
        ...


@runtime_checkable
class HealthSource(Protocol):
    """Reports device health as named numbers and texts, for operators and interlocks."""

    def health(self) -> dict[str, float | int | str | bool]:
        """Return named readings, e.g. dropped frames, temperatures, mode."""
        ...


@runtime_checkable
class NativeWatchdog(Protocol):
    """Has a watchdog in the device, which stops it when the host is silent."""

    def watchdog_s(self) -> float:
        """Return the watchdog period as read back from the device: silence for this long stops it."""
        ...


@runtime_checkable
class ReadingSource(Protocol):
    """Delivers named numbers: a force-torque sensor, a gripper, a scale."""

    def read(self, max_age_s: float | None = None) -> Stamped[Mapping[str, float]]:
        """Return the newest reading, with units in the names ("force_z_n").

        Raises:
            StaleData: the newest reading is older than ``max_age_s``.
        """
        ...


@runtime_checkable
class SettingSink(Protocol):
    """Follows named set values: a gripper, a conveyor."""

    def apply(self, setting: Mapping[str, float]) -> None:
        """Begin to follow ``setting``, with units in the names ("width_mm"). Never blocks for longer than a cycle.

        Raises:
            CommandRejected: a name is unknown, or a value is not finite or out of range.
        """
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
            raise TypeError(f"{each!r} is not a runtime-checkable Protocol class")
