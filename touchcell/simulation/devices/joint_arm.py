"""Driver of a simulated arm with joint dynamics: a Panda or UR5e of rods and servos, with damped least squares.

It sags under load, lags behind its setpoint, has joint limits and slows down near singularities, and contact forces act
on its tool. ``sim_arm`` is the ideal one.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from touchcell.drivers.core.arm import JointLimitsConfig, LimitsConfig
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.joint_arm import JointArm
from touchcell.drivers.core.joint_setpoint import JointSetpoint
from touchcell.drivers.core.protocols import (
    SERVO_ARM,
    ExternalTorqueSource,
    HealthSource,
    JointGoal,
    JointSource,
    StopCategory,
    WrenchSource,
)
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain, Tool
from touchcell.drivers.kinematics.inverse import joints_for_pose
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.input_file import InputFile
from touchcell.simulation.scene import Scene, physics_engine
from touchcell.simulation.timeline import DEFAULT_STEP_S, Phase, Timeline

if TYPE_CHECKING:
    from touchcell.simulation.arm_dynamics import ArmDynamics

CAPABILITIES = Capabilities(
    kind="arm",
    provides=SERVO_ARM | {JointSource, WrenchSource, ExternalTorqueSource, JointGoal, HealthSource},
    state_rate_hz=1.0 / DEFAULT_STEP_S,
    stop_categories=frozenset({1, 2}),
    has_brakes=True,
    virtual_time=True,
)

TOOLS = {
    "straight": Tool(origin_mm=(0.0, 0.0, 72.0), mass_kg=0.25, com_mm=(0.0, 0.0, 30.0)),
    # With the tip across the flange the arm pushes along a table with its wrist up.
    "right_angle": Tool(
        origin_mm=(100.0, 0.0, 35.0), rotation_deg=(0.0, 90.0, 0.0), mass_kg=0.35, com_mm=(40.0, 0.0, 30.0)
    ),
}
"""Tools: a TacTip along the flange's axis, or one on a right-angle bracket along its x axis."""

_POSTURES_DEG = {"panda": (0, 20, 0, -120, 0, 140, 45), "ur5e": (0, -90, -90, -90, 90, 0)}
_READABLE = (Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE, Lifecycle.FAULTED)
_SETPOINT_S = 0.01
# As the drivers of real arms: a compliant arm that stands yields to what moves against its tip.
_REST_SPEED_RAD_S = 0.01


class SimJointArmConfig(DriverConfig):
    """Model, base pose, start pose, tool and limits of the arm.

    Attributes:
        model: which arm.
        start_pose_mm_deg: initial pose of the tool centre point in the base frame.
        base_pose_mm_deg: pose of the base in the world frame.
        tool: tool on the flange, by name or by its pose and mass.
        limits: limits of the tool centre point.
        joint_limits: how joints are kept within their ranges.
        max_ttl_s: longest time-to-live of a command that is accepted.
        state_timeout_s: oldest pose with which a twist may be followed.
        physics_step_ms: step of the dynamics.
    """

    model: Literal["panda", "ur5e"]
    start_pose_mm_deg: tuple[float, float, float, float, float, float]
    near_joints_deg: tuple[float, ...] | None = Field(
        default=None, description="initial guess of the joint angles for the start pose"
    )
    base_pose_mm_deg: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    tool: Literal["straight", "right_angle"] | Tool = "straight"
    limits: LimitsConfig = LimitsConfig()
    joint_limits: JointLimitsConfig = JointLimitsConfig()
    max_ttl_s: float = Field(default=1.0, gt=0.0, le=10.0)
    state_timeout_s: float = Field(default=0.1, gt=0.0, le=1.0)
    physics_step_ms: float = Field(default=1.0, ge=0.05, le=2.0)
    menagerie: Annotated[str | None, InputFile("a checkout of MuJoCo Menagerie", folder=True)] = Field(
        default=None,
        description="checkout of MuJoCo Menagerie whose arm to use, else $MENAGERIE_ROOT; rods if neither is set",
    )

    @property
    def carried(self) -> Tool:
        """The tool on its flange."""
        return TOOLS[self.tool] if isinstance(self.tool, str) else self.tool

    def described_chain(self) -> SerialChain:
        """Return the chain of the model with its tool."""
        return SerialChain(ChainDescription.shipped(self.model), self.carried)


class SimJointArm(JointArm):
    """Driver of a simulated arm with joint dynamics.

    The setpoint moves every 10 ms; in between, the joints follow it by the physics at ``physics_step_ms``.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
        timeline: timeline of the scene that it moves in; its own if None.

    Raises:
        ConfigError: the start pose is unreachable, mujoco is not installed, or Menagerie's arm cannot be used.
    """

    def __init__(self, name: str, config: SimJointArmConfig, clock: Clock, timeline: Timeline | None = None) -> None:
        super().__init__(
            name,
            clock,
            config.limits.build(),
            stop_categories=CAPABILITIES.stop_categories,
            max_ttl_s=config.max_ttl_s,
            max_state_age_s=config.state_timeout_s,
        )
        self._chain = config.described_chain()
        self._ik = DifferentialIk(self._chain, config.joint_limits.settings())
        self._setpoint = JointSetpoint(self._chain, self._ik, self.limits)
        self._latched_fault = None
        self._load = np.zeros(3), np.zeros(3)
        self.T_world_base = se3.from_euler_mm_deg(config.base_pose_mm_deg)
        self._timeline = timeline or Timeline(clock)
        step_s = self._timeline.step_ns * 1e-9
        self._steps = max(1, round(step_s / (1e-3 * config.physics_step_ms)))
        self._steps_per_setpoint = max(1, round(_SETPOINT_S / step_s))
        near = np.deg2rad(config.near_joints_deg or _POSTURES_DEG[config.model])
        if near.shape != (self._chain.joint_count,):
            raise ConfigError(f"is not {self._chain.joint_count} angles", key=f"{name}.near_joints_deg")
        q = joints_for_pose(self._chain, se3.from_euler_mm_deg(config.start_pose_mm_deg), near)
        self._setpoint.reset(q)
        # The setpoint at its last move, and the number of simulation steps since.
        self._from, self._phase = q, 0
        self._body = _dynamics(config, self._chain.description, config.carried, q, step_s / self._steps)
        self._joints = self._sample()
        self._timeline.add(Phase.MOTION, self._step)
        self._timeline.keep(self._snapshot)

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return joint states at the last step of the simulation. Raises StaleData if older than ``max_age_s``."""
        self._require("read its joints", *_READABLE)
        self._timeline.advance()
        self._joints = self._sample()
        return super().joints(max_age_s)

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return tool pose and twist at the last step of the simulation. Raises StaleData."""
        self._require("read its pose", *_READABLE)
        return super().tcp(max_age_s)

    def at_rest(self) -> bool:
        """Return whether setpoint and joints are at standstill."""
        self._timeline.advance()
        return not self._setpoint.moving and bool((np.abs(self._body.dq) <= _REST_SPEED_RAD_S).all())

    def health(self) -> dict[str, float | int | str | bool]:
        """Return the largest joint torque beyond the arm's own weight, lag behind the setpoint, active limits."""
        self._timeline.advance()
        return {
            "torque_n_m": float(np.abs(self._body.torque).max()),
            "lag_deg": float(np.degrees(np.abs(self._setpoint.q - self._body.q).max())),
            "limited_by": ", ".join(adjustment.limit for adjustment in self._setpoint.adjustments),
            "owner": self.owner or "",
        }

    def T_world_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the present pose (4, 4), in any lifecycle state, without advancing time: for scenes."""
        return self.T_world_base @ self._body.T_base_tcp()

    def apply_force(self, force_world: Array, point_world: Array) -> None:
        """Apply ``force_world`` (3,) N at ``point_world`` (3,) m on the tool from now on: for scenes."""
        R, origin = self.T_world_base[:3, :3], self.T_world_base[:3, 3]
        force, point = force_world @ R, (point_world - origin) @ R
        self._load = force, point
        self._body.apply_force(force, point)

    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (6,) [force N, torque N m] on the tool centre point along base axes. Raises StaleData."""
        sample = self.tcp(max_age_s)
        force, point = self._load
        torque = np.cross(point - sample.value.T_base_tcp[:3, 3], force)
        return Stamped(np.concatenate([force, torque]), sample.t_ns, sample.seq)

    def external_torques(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return (n,) N m that the load on the tool puts on the joints. Raises StaleData."""
        joints, wrench = self.joints(max_age_s), self.wrench(max_age_s)
        return Stamped(self._chain.jacobian(joints.value.q).T @ wrench.value, joints.t_ns, joints.seq)

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        self._timeline.advance()
        self._setpoint.follow(twist_base, now_ns + round(ttl_s * 1e9))

    def _begin_stop(self, category: StopCategory) -> None:
        self._timeline.advance()
        self._setpoint.stop()

    def _step(self, t_ns: int) -> None:
        step_ns = self._timeline.step_ns
        if self._phase == 0:
            self._from = self._setpoint.q
            self._setpoint.step(t_ns - step_ns, self._steps_per_setpoint * step_ns * 1e-9)
        dq = self._setpoint.dq
        self._phase += 1
        self._body.set_target(self._from + dq * (self._phase * step_ns * 1e-9), dq)
        self._body.step(self._steps)
        self._phase %= self._steps_per_setpoint

    def _sample(self) -> Stamped[JointState]:
        t_ns = self._timeline.t_ns
        state = JointState(self._body.q, self._body.dq, self._body.torque)
        return Stamped(state, t_ns, t_ns // self._timeline.step_ns)

    def _snapshot(self) -> Callable[[int], None]:
        body, setpoint, start = self._body.snapshot(), self._setpoint.snapshot(), (self._from, self._phase)

        def restore(later_ns: int) -> None:
            body()
            setpoint(later_ns)
            self._from, self._phase = start

        return restore

    def _open(self) -> None:
        self._timeline.advance()

    def _close(self) -> None:
        self._timeline.advance()
        self._setpoint.stop()

    def _recover(self, token: OperatorToken) -> None:
        self._from, self._phase = self._body.q, 0
        self._setpoint.reset(self._from)


def _dynamics(
    config: SimJointArmConfig, description: ChainDescription, tool: Tool, q: Array, step_s: float
) -> ArmDynamics:
    with physics_engine("driver", "sim_joint_arm"):
        from touchcell.simulation.arm_dynamics import ArmDynamics
        from touchcell.simulation.menagerie import menagerie_arm
    root = config.menagerie or os.environ.get("MENAGERIE_ROOT")
    links = menagerie_arm(Path(root), config.model, description) if root else None
    return ArmDynamics(description, tool, q, step_s, links)


def _build(name: str, config: SimJointArmConfig, context: DriverContext) -> SimJointArm:
    scene = context.scene
    return SimJointArm(name, config, context.clock, scene.timeline if isinstance(scene, Scene) else None)


SPEC = DriverSpec(
    name="sim_joint_arm",
    summary="simulated Panda or UR5e with joint dynamics (mujoco)",
    config=SimJointArmConfig,
    capabilities=CAPABILITIES,
    build=_build,
)
