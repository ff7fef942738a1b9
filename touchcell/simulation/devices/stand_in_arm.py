"""Simulated stand-in for a real arm: its kinematic chain, limits, rates, latency and stops, on virtual time.

Joints follow their setpoint exactly: there is no dynamics, no friction and no sag (``sim_joint_arm`` has those).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from touchcell.drivers.core.arm import JointLimitsConfig, LimitsConfig
from touchcell.drivers.core.behaviour import ArmBehaviour
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.errors import CorruptMessage, StaleData
from touchcell.drivers.core.joint_arm import JointArm
from touchcell.drivers.core.joint_setpoint import JointSetpoint
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import ExternalTorqueSource, NativeWatchdog, StopCategory, WrenchSource
from touchcell.drivers.core.samples import JointState, Stamped
from touchcell.drivers.core.spec import AnyDriver, Capabilities, DriverConfig, DriverContext
from touchcell.drivers.core.stand_in import Placement
from touchcell.drivers.kinematics.chain import DifferentialIk, SerialChain
from touchcell.drivers.kinematics.inverse import joints_for_pose
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.devices.delayed_twists import DelayedTwists
from touchcell.simulation.faults import ArmFaults
from touchcell.simulation.scene import Scene
from touchcell.simulation.timeline import DEFAULT_STEP_S, Phase, Timeline

_READABLE = (Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE, Lifecycle.FAULTED)


class StandInArm(JointArm):
    """Driver of a simulated arm that behaves as another driver's.

    Args:
        name: the device's name in the cell.
        config: configuration of the other driver; its ``limits`` and ``joint_limits`` hold here.
        capabilities: of the other driver.
        behaviour: of the other driver's device.
        chain: kinematic chain of the arm, with its tool.
        placement: where it stands and starts.
        clock: injected clock.
        timeline: timeline of the scene that it moves in; its own if None.

    ``faults`` may be set at any time.

    Attributes:
        moved_ns: end of the last step in which it truly moved; 0 before the first.

    Raises:
        ConfigError: the start pose is out of reach.
    """

    def __init__(
        self,
        name: str,
        config: DriverConfig,
        capabilities: Capabilities,
        behaviour: ArmBehaviour,
        chain: SerialChain,
        placement: Placement,
        clock: Clock,
        timeline: Timeline | None = None,
    ) -> None:
        limits = getattr(config, "limits", LimitsConfig()).build()
        super().__init__(
            name,
            clock,
            limits,
            stop_categories=capabilities.stop_categories,
            max_state_age_s=behaviour.max_state_age_s,
        )
        self.faults = ArmFaults()
        self.moved_ns = 0
        self._behaviour = behaviour
        self._chain = chain
        joint_limits: JointLimitsConfig = getattr(config, "joint_limits", JointLimitsConfig())
        self._ik = DifferentialIk(chain, joint_limits.settings())
        stopping = replace(
            limits,
            accel_m_s2=behaviour.stop_accel_m_s2 or limits.accel_m_s2,
            rot_accel_rad_s2=behaviour.stop_rot_accel_rad_s2 or limits.rot_accel_rad_s2,
        )
        self._setpoint = JointSetpoint(chain, self._ik, limits, stopping)
        self._latched_fault = None
        q = np.deg2rad(behaviour.home_deg)
        if placement.start_pose_mm_deg is not None:
            q = joints_for_pose(chain, se3.from_euler_mm_deg(placement.start_pose_mm_deg), q)
        self._setpoint.reset(q)
        self.T_world_base = se3.from_euler_mm_deg(placement.base_pose_mm_deg)
        self._timeline = timeline or Timeline(clock)
        self._period_ns = max(round(1e9 / behaviour.state_rate_hz), self._timeline.step_ns)
        self._latency_ns = round(behaviour.latency_s * 1e9)
        self._on_the_way = DelayedTwists()
        self._powered = False
        self._load = np.zeros(3), np.zeros(3)
        self._reported: Stamped[JointState] | None = None
        self._joints = self._sample()
        self._timeline.add(Phase.MOTION, self._step)
        self._timeline.keep(self._snapshot)

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return the newest state that the arm has sent. Raises StaleData if it is older than ``max_age_s``."""
        self._require("read its joints", *_READABLE)
        self._timeline.advance()
        sample = self._joints
        assert sample is not None
        if self.faults.nan_state:
            # As real drivers do after some bad states in a row.
            raise self._to_faulted(CorruptMessage(self.name, "states with numbers that are not finite"))
        if self.faults.stale and self._reported is not None:
            sample = self._reported
        self._reported = sample
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and not age_s <= max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return sample

    def at_rest(self) -> bool:
        """Return whether it is at rest with no motion pending, as far as the newest state that it has sent shows."""
        self._timeline.advance()
        if self.faults.stale and self._reported is not None:
            return not self._reported.value.dq.any()
        return not (self._setpoint.moving or self._on_the_way or self._drift_m_s())

    def go_to_joints(self, q: Array, lease: Lease, *, speed_fraction: float = 0.1) -> None:
        """Start moving to ``q`` (n,) rad in a straight line in joint space. Raises CommandRejected."""
        self._timeline.advance()
        super().go_to_joints(q, lease, speed_fraction=speed_fraction)

    def health(self) -> dict[str, float | int | str | bool]:
        """Return whether it has power, which limits are active, and the lease holder."""
        self._timeline.advance()
        limited = ", ".join(adjustment.limit for adjustment in self._setpoint.adjustments)
        return {"powered": self._powered, "limited_by": limited, "owner": self.owner or ""}

    def T_world_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the present pose (4, 4), in any lifecycle state, without advancing time: for scenes."""
        T: Array = self.T_world_base @ self._chain.forward_and_jacobian(self._setpoint.q)[0]
        return T

    def apply_force(self, force_world: Array, point_world: Array) -> None:
        """Apply ``force_world`` (3,) N at ``point_world`` (3,) m on the tool from now on: for scenes."""
        R, origin = self.T_world_base[:3, :3], self.T_world_base[:3, 3]
        self._load = force_world @ R, (point_world - origin) @ R

    def _wrench(self, max_age_s: float | None) -> Stamped[Array]:
        """Return (6,) [force N, torque N m] on the tool centre point along base axes."""
        sample = self.tcp(max_age_s)
        force, point = self._load
        torque = np.cross(point - sample.value.T_base_tcp[:3, 3], force)
        return Stamped(np.concatenate([force, torque]), sample.t_ns, sample.seq)

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        self._timeline.advance()
        expires_ns = now_ns + round(ttl_s * 1e9)
        # The device counts a command's time-to-live from its arrival, as ``sim_arm`` does.
        self._on_the_way.add(twist_base, now_ns + self._latency_ns, expires_ns + self._latency_ns)

    def _begin_stop(self, category: StopCategory) -> None:
        self._timeline.advance()
        if self.faults.ignores_stops:
            return
        self._on_the_way.clear()
        self._powered = category is StopCategory.STOP_AND_HOLD
        if not (self.faults.ignores_expiry and self._powered):
            self._setpoint.stop()

    def _step(self, t_ns: int) -> None:
        step_ns = self._timeline.step_ns
        for late in self._on_the_way.arrived(t_ns - step_ns):
            self._setpoint.follow(late.twist_base, late.expires_ns)
        if self.faults.ignores_expiry and self._powered and self._setpoint.twist.any():
            self._setpoint.follow(self._setpoint.twist, t_ns + step_ns)
        self._setpoint.step(t_ns - step_ns, step_ns * 1e-9)
        if self._drift_m_s():
            self._setpoint.q = self._setpoint.q + self._sinking() * (step_ns * 1e-9)
        if t_ns // self._period_ns != self._joints_t_ns // self._period_ns:
            self._joints = self._sample()
        if self._setpoint.moving or self._drift_m_s():
            self.moved_ns = t_ns

    @property
    def _joints_t_ns(self) -> int:
        return 0 if self._joints is None else self._joints.t_ns

    def _sample(self) -> Stamped[JointState]:
        t_ns = self._timeline.t_ns
        dq = self._setpoint.dq
        if self._drift_m_s():
            dq = dq + self._sinking()
        state = JointState(self._setpoint.q, dq, np.zeros_like(dq))
        return Stamped(state, t_ns, t_ns // self._period_ns)

    def _sinking(self) -> Array:
        """Return joint speeds (n,) at which the tool sinks by the fault's drift."""
        sinks = np.array([0.0, 0.0, -self._drift_m_s(), 0.0, 0.0, 0.0])
        speeds: Array = np.linalg.lstsq(self._chain.jacobian(self._setpoint.q), sinks, rcond=None)[0]
        return speeds

    def _snapshot(self) -> Callable[[int], None]:
        powered, setpoint, on_the_way = self._powered, self._setpoint.snapshot(), self._on_the_way.snapshot()

        def restore(later_ns: int) -> None:
            self._powered = powered
            on_the_way(later_ns)
            setpoint(later_ns)

        return restore

    def _drift_m_s(self) -> float:
        return self.faults.drift_m_s if self._powered else 0.0

    def _activate(self) -> None:
        self._powered = True

    def _open(self) -> None:
        self._timeline.advance()

    def _close(self) -> None:
        self._timeline.advance()
        self._reset_state()

    def _recover(self, token: OperatorToken) -> None:
        self._reset_state()

    def _reset_state(self) -> None:
        self._on_the_way.clear()
        self._powered = False
        self._setpoint.reset(self._setpoint.q)


class _Wrench(StandInArm):
    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (6,) [force N, torque N m] on the tool centre point along base axes. Raises StaleData."""
        return self._wrench(max_age_s)


class _Torques(StandInArm):
    def external_torques(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (n,) N m that the load on the tool puts on the joints. Raises StaleData."""
        joints, wrench = self.joints(max_age_s), self._wrench(max_age_s)
        return Stamped(self._chain.jacobian(joints.value.q).T @ wrench.value, joints.t_ns, joints.seq)


class _Watchdog(StandInArm):
    def watchdog_s(self) -> float:
        """Return the silence after which the real device stops by itself; here every command expires in time."""
        return self._behaviour.watchdog_s or 0.0


_ABILITIES: dict[type, type[StandInArm]] = {
    WrenchSource: _Wrench,
    ExternalTorqueSource: _Torques,
    NativeWatchdog: _Watchdog,
}
"""What only some arms can do."""


def stand_in(spec: AnyDriver, placement: Placement) -> AnyDriver:
    """Return a simulated driver with the name, configuration and capabilities of ``spec``.

    Raises (when it builds):
        ConfigError: the driver describes neither its behaviour nor its chain, or the start pose is out of reach.
    """
    able = replace(
        spec.capabilities,
        virtual_time=True,
        hardware_validated=False,
        state_rate_hz=min(spec.capabilities.state_rate_hz, 1.0 / DEFAULT_STEP_S),
    )
    bases = tuple(each for protocol, each in _ABILITIES.items() if protocol in able.provides)
    arm_type: type[StandInArm] = type("StandInArm", bases, {}) if bases else StandInArm

    def build(name: str, config: DriverConfig, context: DriverContext) -> StandInArm:
        behaviour = None if spec.behaviour is None else spec.behaviour(config)
        chain = config.described_chain()
        if not isinstance(behaviour, ArmBehaviour) or chain is None:
            raise ConfigError(
                f"{spec.name} describes no behaviour and chain to simulate", key=f"arms.{name}.driver", value=spec.name
            )
        timeline = context.scene.timeline if isinstance(context.scene, Scene) else None
        return arm_type(name, config, able, behaviour, chain, placement, context.clock, timeline)

    return replace(spec, summary=f"simulated: {spec.summary}", capabilities=able, build=build)
