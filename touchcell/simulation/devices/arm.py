"""Driver of a simulated arm: a tool centre point that follows twists exactly within its acceleration limits.

It has no joints, no singularities and no tracking error beyond those limits; it is for tasks, not for arm dynamics.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from pydantic import Field

from touchcell.drivers.core.arm import Arm, LimitsConfig
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.errors import StaleData
from touchcell.drivers.core.protocols import SERVO_ARM, HealthSource, StopCategory
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.devices.delayed_twists import DelayedTwists
from touchcell.simulation.faults import ArmFaults
from touchcell.simulation.kinematics import TwistFollower
from touchcell.simulation.scene import Scene
from touchcell.simulation.timeline import DEFAULT_STEP_S, Phase, Timeline

CAPABILITIES = Capabilities(
    kind="arm",
    provides=SERVO_ARM | {HealthSource},
    state_rate_hz=1.0 / DEFAULT_STEP_S,
    stop_categories=frozenset({1, 2}),
    has_brakes=True,
    virtual_time=True,
)

_READABLE = (Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE, Lifecycle.FAULTED)


class SimArmConfig(DriverConfig):
    """Base pose, start pose, limits and latency of the arm; the latency delays twists, not stops.

    Attributes:
        start_pose_mm_deg: initial pose of the tool centre point in the base frame.
        base_pose_mm_deg: pose of the base in the world frame.
        limits: limits of the tool centre point.
        latency_ms: delay of twists; stops are not delayed.
        lag_ms: time constant with which the arm follows its twist.
        velocity_step_mm_s: resolution of its velocity; 0 for any velocity.
        velocity_step_deg_s: resolution of its angular velocity, likewise.
        max_ttl_s: longest time-to-live of a command that is accepted.
        state_timeout_s: oldest pose with which a twist may be followed.
    """

    start_pose_mm_deg: tuple[float, float, float, float, float, float]
    base_pose_mm_deg: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    limits: LimitsConfig = LimitsConfig()
    latency_ms: float = Field(default=0.0, ge=0.0, le=500.0)
    lag_ms: float = Field(default=0.0, ge=0.0, le=500.0)
    velocity_step_mm_s: float = Field(default=0.0, ge=0.0, le=10.0)
    velocity_step_deg_s: float = Field(default=0.0, ge=0.0, le=10.0)
    max_ttl_s: float = Field(default=1.0, gt=0.0, le=10.0)
    state_timeout_s: float = Field(default=0.1, gt=0.0, le=1.0)


class SimArm(Arm):
    """Driver of a simulated arm.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
        timeline: timeline of the scene that it moves in; its own if None.

    ``faults`` may be set at any time.
    """

    def __init__(self, name: str, config: SimArmConfig, clock: Clock, timeline: Timeline | None = None) -> None:
        super().__init__(
            name,
            clock,
            config.limits.build(),
            stop_categories=CAPABILITIES.stop_categories,
            max_ttl_s=config.max_ttl_s,
            max_state_age_s=config.state_timeout_s,
        )
        self.faults = ArmFaults()
        self.moved_ns = 0
        self.T_world_base = se3.from_euler_mm_deg(config.base_pose_mm_deg)
        self._timeline = timeline or Timeline(clock)
        self._body = TwistFollower(
            se3.from_euler_mm_deg(config.start_pose_mm_deg),
            self.limits,
            self._timeline.step_ns,
            lag_s=1e-3 * config.lag_ms,
            resolution=(1e-3 * config.velocity_step_mm_s, math.radians(config.velocity_step_deg_s)),
        )
        self._latency_ns = round(config.latency_ms * 1e6)
        self._on_the_way = DelayedTwists()
        self._powered = False
        self._last_reported: Stamped[TcpState] | None = None
        self._timeline.add(Phase.MOTION, self._step)
        self._timeline.keep(self._snapshot)

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the state at the last step of the simulation. Raises StaleData if it is older than ``max_age_s``."""
        self._require("read its pose", *_READABLE)
        t_ns = self._timeline.advance()
        state = TcpState(self._body.T_base_tcp.copy(), self._velocity())
        if self.faults.nan_state:
            state = TcpState(np.full((4, 4), np.nan), np.full(6, np.nan))
        sample = Stamped(state, t_ns, t_ns // self._timeline.step_ns)
        if self.faults.stale and self._last_reported is not None:
            sample = self._last_reported
        self._last_reported = sample
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return sample

    def at_rest(self) -> bool:
        """Return whether it is at rest with no motion pending."""
        self._timeline.advance()
        return self._body.at_rest() and not (self._on_the_way or self._velocity().any())

    def health(self) -> dict[str, float | int | str | bool]:
        """Return the speeds of the tool centre point and the lease holder."""
        self._timeline.advance()
        velocity = self._body.velocity
        return {
            "speed_m_s": float(np.linalg.norm(velocity[:3])),
            "rot_speed_rad_s": float(np.linalg.norm(velocity[3:])),
            "owner": self.owner or "",
        }

    def T_world_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the present pose (4, 4), in any lifecycle state, without advancing time: for scenes."""
        return self.T_world_base @ self._body.T_base_tcp

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        self._timeline.advance()
        expires_ns = now_ns + round(ttl_s * 1e9)
        if self._latency_ns:
            self._on_the_way.add(twist_base, now_ns + self._latency_ns, expires_ns + self._latency_ns)
        else:
            self._body.follow(twist_base, expires_ns)

    def _begin_stop(self, category: StopCategory) -> None:
        self._timeline.advance()
        if self.faults.ignores_stops:
            return
        self._on_the_way.clear()
        self._powered = category is StopCategory.STOP_AND_HOLD
        if not (self.faults.ignores_expiry and self._powered):
            self._body.halt()

    def _step(self, t_ns: int) -> None:
        for late in self._on_the_way.arrived(t_ns - self._timeline.step_ns):
            self._body.follow(late.twist_base, late.expires_ns)
        if self.faults.ignores_expiry and self._powered:
            self._body.prolong(t_ns)
        self._body.step(t_ns)
        if not self._body.at_rest() or self._drift_m_s():
            self.moved_ns = t_ns
        drift_m_s = self._drift_m_s()
        if drift_m_s:
            T = self._body.T_base_tcp.copy()
            T[2, 3] -= drift_m_s * self._timeline.step_ns * 1e-9
            self._body.T_base_tcp = T

    def _snapshot(self) -> Callable[[int], None]:
        """Snapshot the body only: leases are not part of the simulation."""
        powered, body, on_the_way = self._powered, self._body.snapshot(), self._on_the_way.snapshot()

        def restore(later_ns: int) -> None:
            self._powered = powered
            on_the_way(later_ns)
            body(later_ns)

        return restore

    def _velocity(self) -> Array:
        velocity = self._body.velocity.copy()
        velocity[2] -= self._drift_m_s()
        return velocity

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
        self._body.freeze()


def _build(name: str, config: SimArmConfig, context: DriverContext) -> SimArm:
    scene = context.scene
    return SimArm(name, config, context.clock, scene.timeline if isinstance(scene, Scene) else None)


SPEC = DriverSpec(
    name="sim_arm",
    summary="simulated arm with ideal kinematics",
    config=SimArmConfig,
    capabilities=CAPABILITIES,
    build=_build,
)
