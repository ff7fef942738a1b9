"""Base class of arms whose driver controls the joints: its loop publishes joint states and latches faults."""

from __future__ import annotations

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, DeviceError, Rejection, StaleData
from touchcell.drivers.core.joint_setpoint import JointSetpoint
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.drivers.kinematics.chain import DifferentialIk, LocalIk, SerialChain
from touchcell.geometry.types import Array


class JointArm(Arm):
    """An arm with a kinematic chain, a joint-space setpoint, and a loop that sets ``_joints`` and ``_latched_fault``.

    Subclasses create the attributes below before the loop starts.
    """

    _chain: SerialChain
    _ik: DifferentialIk
    _setpoint: JointSetpoint
    _joints: Stamped[JointState] | None
    _latched_fault: DeviceError | None

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return the newest joint states, stamped at the request. Raises StaleData."""
        sample = self._joints
        if sample is None:
            raise StaleData(self.name, float("inf"), max_age_s or 0.0, 0, hint="not all joints have answered yet")
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and not age_s <= max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return sample

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the newest tool pose and twist, computed from measured joint angles. Raises StaleData."""
        sample = self.joints(max_age_s)
        T_base_tcp, J = self._chain.forward_and_jacobian(sample.value.q)
        state = TcpState(T_base_tcp, J @ sample.value.dq)
        return Stamped(state, sample.t_ns, sample.seq, quality=sample.quality)

    def go_to_joints(self, q: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving to ``q`` (n,) rad in a straight line in joint space, within the limits of the tool centre point.

        Raises:
            CommandRejected: not finite, wrong shape, no lease, not active, outside the joint limits.
        """
        q = self._admitted_joint_goal(
            q, lease, speed_fraction, self._chain.lower, self._chain.upper, self._chain.joint_count
        )
        if self._latched_fault is not None:
            raise CommandRejected(self.name, Rejection.MODE, f"device fault: {self._latched_fault}")
        self._setpoint.go_to(q, speed_fraction)

    def kinematics(self) -> DifferentialIk:
        """Return the differential inverse kinematics of the arm."""
        return self._ik

    def _local_ik(self) -> LocalIk:
        return self._ik_at(self._ik, self.joints(self._max_state_age_s).value.q)

    def _present_fault(self) -> DeviceError | None:
        return self._latched_fault

    def _latch(self, error: DeviceError) -> None:
        """Store the first fault, stop the setpoint, and set FAULTED."""
        new = self._latched_fault is None
        if self._latched_fault is None:
            self._latched_fault = error
            self._setpoint.stop()
        # While it connects the state is DISCONNECTED, so every cycle sets it again; in FAULTED, only what is new.
        if self.state is not Lifecycle.DISCONNECTED and (new or self.state is not Lifecycle.FAULTED):
            self._to_faulted(self._latched_fault)
