"""What every arm has in common: one lease, one gate, and rest whenever either is given up.

A driver fills in ``tcp``, ``at_rest``, ``_stream_twist`` and ``_begin_stop`` besides the hooks of ``Device``
(``_after_rest`` in place of ``_deactivate``). It never sees a command that is not finite, along base axes, owned, fresh
and within the limits.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Self, final

import numpy as np
from pydantic import Field, model_validator

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.command_checks import finite_array, finite_number
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Device, Lifecycle
from touchcell.drivers.core.errors import (
    CommandRejected,
    DeviceError,
    DeviceFault,
    FaultClass,
    LifecycleError,
    Rejection,
)
from touchcell.drivers.core.gate import TwistGate, TwistLimits
from touchcell.drivers.core.lease import Lease, LeaseManager
from touchcell.drivers.core.protocols import StopCategory
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.core.spec import DriverConfig
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.drivers.kinematics.joint_limits import IkSettings
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array
from touchcell.logs import OncePerCause

if TYPE_CHECKING:
    from touchcell.drivers.kinematics.chain import DifferentialIk, LocalIk

_logger = logging.getLogger(__name__)

_REST_POLL_NS = 5_000_000
_REST_MARGIN_S = 1.0
_SHORTEST_TTL_S = 1e-3


class LimitsConfig(DriverConfig):
    """The ``limits:`` of an arm in the cell file: speeds, accelerations and jerks of the tool centre point.

    Attributes:
        tcp_speed_m_s: largest linear speed.
        tcp_accel_m_s2: largest linear acceleration.
        tcp_rot_speed_rad_s: largest angular speed.
        tcp_rot_accel_rad_s2: largest angular acceleration.
        tcp_jerk_m_s3: largest linear jerk.
        tcp_rot_jerk_rad_s3: largest angular jerk.
    """

    tcp_speed_m_s: float = Field(default=0.10, gt=0.0, le=1.0)
    tcp_accel_m_s2: float = Field(default=0.5, gt=0.0, le=10.0)
    tcp_rot_speed_rad_s: float = Field(default=0.5, gt=0.0, le=4.0)
    tcp_rot_accel_rad_s2: float = Field(default=2.5, gt=0.0, le=20.0)
    tcp_jerk_m_s3: float = Field(default=50.0, gt=0.0, le=5000.0)
    tcp_rot_jerk_rad_s3: float = Field(default=250.0, gt=0.0, le=20000.0)

    def build(self) -> TwistLimits:
        """The gate's limits."""
        return TwistLimits(
            self.tcp_speed_m_s,
            self.tcp_accel_m_s2,
            self.tcp_rot_speed_rad_s,
            self.tcp_rot_accel_rad_s2,
            self.tcp_jerk_m_s3,
            self.tcp_rot_jerk_rad_s3,
        )


class Arm(Device):
    """An arm that follows expiring twists of its tool centre point.

    Args:
        name: the device's name in the cell.
        clock: injected time.
        limits: what the gate allows.
        stop_categories: IEC 60204-1 categories that the driver offers in software.
        max_ttl_s: longest time-to-live accepted.
        max_state_age_s: oldest pose with which a twist along tool axes may be turned to base axes.

    Giving the lease back, leaving ACTIVE and faults all stop the arm, void the lease and reset the gate.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        limits: TwistLimits,
        *,
        stop_categories: Iterable[int] = (StopCategory.STOP_AND_HOLD,),
        max_ttl_s: float = 1.0,
        max_state_age_s: float = 0.1,
    ) -> None:
        super().__init__(name, clock)
        self._limits = limits
        self._stop_categories = frozenset(StopCategory(category) for category in stop_categories)
        self._max_state_age_s = max_state_age_s
        self._desk = LeaseManager(name)
        self._refusals = OncePerCause(_logger)
        self._gate = TwistGate(name, limits, self._desk, clock, max_ttl_s=max_ttl_s)
        self._stop_count = 0

    @property
    def limits(self) -> TwistLimits:
        """What the gate allows."""
        return self._limits

    @property
    def stop_categories(self) -> frozenset[StopCategory]:
        """Stop categories that it offers in software."""
        return self._stop_categories

    @property
    def owner(self) -> str | None:
        """Who holds the command lease."""
        return self._desk.owner

    @final
    def acquire(self, owner: str) -> Lease:
        """Take the command lease. Raises CommandRejected(LEASE) while another holds it."""
        return self._desk.acquire(owner)

    @final
    def release(self, lease: Lease) -> None:
        """Give the lease back and stop. A lease that is no longer held changes nothing."""
        try:
            self._desk.check(lease)
        except CommandRejected:
            return
        self._desk.release(lease)
        self.stop()

    @final
    def send_twist(self, command: TwistCommand, lease: Lease) -> Sent[TwistCommand]:
        """Follow ``command`` until it expires; returns what was really sent, along base axes.

        Raises:
            CommandRejected: nothing was sent; ``reason`` gives the cause.
            StaleData: the pose is too old to turn a twist along tool axes, or the joints to be kept within limits.
        """
        stop_count = self._stop_count
        try:
            sent = self._gate.admit(
                command, lease, self.state, self._tool_pose(command), self._project_to_feasible, self._local_ik
            )
        except CommandRejected as error:
            self._refusals.warning(error.reason, "%s", error)
            raise
        self._refusals.forget()
        admitted = sent.command
        left_s = admitted.ttl_s - (sent.t_ns - admitted.t_ns) * 1e-9
        self._stream_twist(admitted.twist, max(left_s, _SHORTEST_TTL_S), sent.t_ns)
        if self._stop_count != stop_count or self.state is not Lifecycle.ACTIVE:
            # Another thread has stopped or faulted the arm since; the twist may have reached it after that stop.
            self._gate.reset()
            if self.state in (Lifecycle.ACTIVE, Lifecycle.FAULTED):
                with suppress(DeviceError):
                    self._begin_stop(StopCategory.STOP_AND_HOLD)
            raise CommandRejected(self.name, Rejection.MODE, "stopped while the command was on its way")
        return sent

    @final
    def stop(self, category: StopCategory = StopCategory.STOP_AND_HOLD) -> None:
        """Begin to stop at once and drop the setpoint; needs no lease. An arm that is not energised ignores it.

        STOP_AND_HOLD leaves the lease with its owner; the categories that remove power void it and end in READY.

        Raises:
            LifecycleError: the driver does not offer ``category``.
        """
        if category not in self._stop_categories:
            offered = [f"category {offer}" for offer in sorted(self._stop_categories)]
            raise LifecycleError(
                self.name, f"stop by category {int(category)}", self.state.value, offered, hint="not offered here"
            )
        if self.state not in (Lifecycle.ACTIVE, Lifecycle.FAULTED):
            return
        self._count_stop()
        self._gate.reset()
        removes_power = category is not StopCategory.STOP_AND_HOLD
        if removes_power:
            self._desk.revoke()
        self._begin_stop(category)
        if removes_power:
            # Not over a fault that a thread of the driver has latched since.
            self._change_state(Lifecycle.ACTIVE, Lifecycle.READY)

    @abstractmethod
    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Newest state. Raises StaleData if it is older than ``max_age_s``."""

    @abstractmethod
    def at_rest(self) -> bool:
        """Whether it stands still now."""

    @abstractmethod
    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        """Hand an admitted twist to the device; must not block for more than a period.

        Args:
            twist_base: (6,) [v, w] of the tool centre point along base axes.
            ttl_s: what is left of its time-to-live, at least 1 ms; the device must be stopping after it.
            now_ns: when the gate admitted it.
        """

    @abstractmethod
    def _begin_stop(self, category: StopCategory) -> None:
        """Begin to stop at once and return; called in ACTIVE and FAULTED, with an offered category only."""

    def _project_to_feasible(self, twist_base: Array) -> tuple[Array, tuple[Adjustment, ...]]:
        """What the arm can follow of a twist, and why it differs: all of it, unless a driver knows better."""
        return twist_base, ()

    def kinematics(self) -> DifferentialIk | None:
        """Of its joints, for an arm that reports them and whose chain is known; None for others."""
        return None

    def _local_ik(self) -> LocalIk | None:
        """The same where the joints are now, for the gate to keep them within limits.

        Raises StaleData, and CommandRejected for angles that are not finite.
        """
        return None

    def _ik_at(self, ik: DifferentialIk, q: Array) -> LocalIk:
        """``ik`` at the measured joint angles ``q``. Raises CommandRejected if they are none."""
        if not np.isfinite(q).all():
            raise CommandRejected(self.name, Rejection.NON_FINITE, "the arm's own joint angles are not finite", value=q)
        return ik.at(q)

    def _after_rest(self, policy: DeactivatePolicy) -> None:
        """Obey ``policy``; called when the arm stands still."""

    @final
    def _deactivate(self, policy: DeactivatePolicy) -> None:
        self._give_up_command()
        self._begin_stop(StopCategory.STOP_AND_HOLD)
        self.await_rest()
        self._after_rest(policy)

    @final
    def _to_faulted(self, error: DeviceError) -> DeviceError:
        with self._state_lock:
            was_active = self.state is Lifecycle.ACTIVE
            latched = super()._to_faulted(error)
        if was_active:
            self._give_up_command()
            # The device may be gone; the first fault is the one to report.
            with suppress(DeviceError):
                self._begin_stop(StopCategory.STOP_AND_HOLD)
        return latched

    def _count_stop(self) -> None:
        with self._state_lock:
            self._stop_count += 1

    def _give_up_command(self) -> None:
        self._count_stop()
        self._desk.revoke()
        self._gate.reset()

    @final
    def await_rest(self) -> None:
        """Wait until it stands. Raises DeviceFault if it still moves long after it could have stopped."""
        limits = self._limits
        braking_s = max(limits.speed_m_s / limits.accel_m_s2, limits.rot_speed_rad_s / limits.rot_accel_rad_s2)
        deadline_ns = self._clock.now_ns() + round((braking_s + _REST_MARGIN_S) * 1e9)
        while not self.at_rest():
            now_ns = self._clock.now_ns()
            if now_ns >= deadline_ns:
                raise self._to_faulted(
                    DeviceFault(
                        self.name,
                        f"still moving {braking_s + _REST_MARGIN_S:.2f} s after a stop",
                        fault_class=FaultClass.MOTION,
                        hint="use the emergency stop",
                    )
                )
            self._clock.sleep_until_ns(now_ns + _REST_POLL_NS)

    def _admitted_joint_goal(
        self, q: Array, lease: Lease, speed_fraction: float, lower: Array | float, upper: Array | float, joints: int
    ) -> Array:
        """A joint goal (joints,) rad that may be sent: finite, of that shape, owned, in ACTIVE and within the limits.

        The order is the twist gate's. Raises CommandRejected with the first reason that applies.
        """
        speed_fraction = finite_number(self.name, "speed fraction", speed_fraction)
        target = finite_array(self.name, "joint goal", q, (joints,))
        self._desk.check(lease)
        if self.state is not Lifecycle.ACTIVE:
            raise CommandRejected(self.name, Rejection.MODE, f"device is {self.state.value}, not active")
        if not (0.0 < speed_fraction <= 1.0 and (target >= lower).all() and (target <= upper).all()):
            raise CommandRejected(
                self.name,
                Rejection.LIMIT,
                "joint goal or speed fraction is outside the limits",
                value=q,
                limit=(lower, upper),
            )
        return target

    def _tool_pose(self, command: TwistCommand) -> Array:
        # Elsewhere the gate refuses the command, or does not turn it.
        if self.state is not Lifecycle.ACTIVE or command.frame is not TwistFrame.TCP:
            return np.eye(4)
        T_base_tcp = self.tcp(self._max_state_age_s).value.T_base_tcp
        if not all_finite(T_base_tcp):
            raise CommandRejected(self.name, Rejection.NON_FINITE, "the arm's own pose is not finite", value=T_base_tcp)
        return T_base_tcp


class JointLimitsConfig(DriverConfig):
    """The ``joint_limits:`` of an arm in the cell file; ranges, speeds and accelerations are in its chain file.

    Attributes:
        margin_deg: distance to the end of a joint's range within which outward speed falls to zero.
        characteristic_length_mm: length that makes a radian comparable to a distance, about half the arm's reach.
        singular_value_mm: singular value of the Jacobian below which its direction is damped.
        singular_floor_mm: smallest singular value; motion that would reduce it further is refused.
    """

    margin_deg: float = Field(default=5.0, gt=0.0, le=45.0)
    characteristic_length_mm: float = Field(default=250.0, gt=0.0, le=2000.0)
    singular_value_mm: float = Field(default=40.0, gt=0.0, le=500.0)
    singular_floor_mm: float = Field(default=20.0, gt=0.0, le=500.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.singular_floor_mm >= self.singular_value_mm:
            raise ValueError(
                f"singular_floor_mm {self.singular_floor_mm:g} is not below "
                f"singular_value_mm {self.singular_value_mm:g}"
            )
        return self

    def settings(self, *, own_controller: bool = False) -> IkSettings:
        """For an arm whose joints we drive, or whose own controller turns twists into joint velocities."""
        return IkSettings(
            characteristic_length_m=1e-3 * self.characteristic_length_mm,
            singular_value_m=1e-3 * self.singular_value_mm,
            singular_floor_m=1e-3 * self.singular_floor_mm,
            damping_m=0.0 if own_controller else 1e-3 * self.singular_value_mm,
            limit_margin_rad=float(np.deg2rad(self.margin_deg)),
            uses_null_space=not own_controller,
        )
