"""Kinematics of serial arms without a vendor model: forward and differential inverse kinematics, gravity torques.

A chain is described in YAML (``touchcell/drivers/kinematics/chains``): per joint its placement in the previous link,
its axis, its limits, and the mass and centre of mass of the link that it moves. All joints are revolute. Depends on
numpy only.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from touchcell.drivers.kinematics import urdf
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.drivers.kinematics.engine import PinocchioEngine
from touchcell.drivers.kinematics.joint_limits import (
    IkSettings,
    off_singularity,
    speed_bounds,
    within_acceleration,
    within_bounds,
)
from touchcell.errors import ConfigError
from touchcell.geometry.errors import GeometryError
from touchcell.geometry.types import Array
from touchcell.input_file import InputFile, files_in, read_yaml

_CHAINS = Path(__file__).parent / "chains"
ChainFile = Annotated[
    str,
    InputFile("a chain", files_in(_CHAINS, ".yaml"), suffixes=(".yaml", ".yml", urdf.SUFFIX), has_parts=True),
]
"""Key of a driver that names a shipped chain, a YAML file with one, or a URDF file (``#TIP`` or ``#BASE:TIP``)."""

Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]

GRAVITY_M_S2 = (0.0, 0.0, -9.80665)
"""Standard gravity (ISO 80000-3) along the axes of an upright base."""


class _Description(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class Placement(_Description):
    """Pose of a frame in the previous one; the angles are extrinsic xyz, R = Rz Ry Rx."""

    origin_mm: Vector3 = (0.0, 0.0, 0.0)
    rotation_deg: Vector3 = (0.0, 0.0, 0.0)

    def pose(self) -> Array:
        """Return the pose as (4, 4)."""
        T = np.eye(4)
        for axis, angle_deg in zip(np.eye(3), self.rotation_deg, strict=True):
            T[:3, :3] = _rotation(axis, np.deg2rad(angle_deg)) @ T[:3, :3]
        T[:3, 3] = np.array(self.origin_mm) * 1e-3
        return T


class CapsuleShape(_Description):
    """Capsule of a link for collision distances: all points within a radius of a segment, in the link's frame."""

    from_mm: Vector3
    to_mm: Vector3
    radius_mm: Positive


class Joint(Placement):
    """A revolute joint and the link that it moves.

    At zero, the joint frame is at ``origin_mm`` and ``rotation_deg`` in the previous link; ``axis``, ``com_mm`` and
    ``capsules`` are given in the joint frame.
    """

    name: str
    axis: Vector3 = (0.0, 0.0, 1.0)
    lower_deg: float
    upper_deg: float
    speed_deg_s: Positive
    accel_deg_s2: Positive = 400.0
    torque_n_m: Positive
    mass_kg: NotNegative = 0.0
    com_mm: Vector3 = (0.0, 0.0, 0.0)
    capsules: tuple[CapsuleShape, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.lower_deg >= self.upper_deg:
            raise ValueError(f"joint {self.name!r}: lower_deg {self.lower_deg} is not below upper_deg {self.upper_deg}")
        if not np.linalg.norm(self.axis) > 0.0:
            raise ValueError(f"joint {self.name!r}: axis has no length")
        return self


class Tool(Placement):
    """Tool on the flange: pose of the tool centre point, and mass and centre of mass in the flange frame.

    Attributes:
        origin_mm: position of the tool centre point in the flange frame.
        rotation_deg: its orientation there, extrinsic xyz.
        mass_kg: mass of the tool.
        com_mm: centre of mass in the flange frame.
    """

    mass_kg: NotNegative = 0.0
    com_mm: Vector3 = (0.0, 0.0, 0.0)


class ChainDescription(_Description):
    """A serial arm, base to flange; ``base_capsules`` are in the base frame."""

    name: str
    base_capsules: tuple[CapsuleShape, ...] = ()
    joints: tuple[Joint, ...] = Field(min_length=1)
    flange: Placement = Placement()

    @classmethod
    def read(cls, path: Path) -> ChainDescription:
        """Read a YAML file. Raises ConfigError with the file and the invalid entry."""
        try:
            return cls.model_validate(read_yaml(path))
        except (OSError, yaml.YAMLError, ValidationError) as error:
            raise ConfigError(f"is not a valid chain description: {error}", file=str(path)) from None

    @classmethod
    def from_urdf(cls, name: urdf.UrdfName) -> ChainDescription:
        """Read the arm in a URDF file. Raises ConfigError with the file and what is wrong."""
        fields = urdf.read_chain(name)
        try:
            return cls.model_validate(fields)
        except ValidationError as error:
            raise ConfigError(f"is not a valid chain: {error}", file=str(name.file)) from None

    @classmethod
    def shipped(cls, name: str) -> ChainDescription:
        """Return a description shipped with touchcell. Raises ConfigError for an unknown name."""
        known = sorted(path.stem for path in _CHAINS.glob("*.yaml"))
        if name not in known:
            raise ConfigError(f"unknown chain {name!r}", key="chain", value=name, hint=f"known: {', '.join(known)}")
        return cls.read(_CHAINS / f"{name}.yaml")

    @classmethod
    def named(cls, chain: str) -> ChainDescription:
        """Return a shipped description, or read it if ``chain`` names a YAML or URDF file. Raises ConfigError."""
        if (name := urdf.parse_name(chain)).file.suffix == urdf.SUFFIX:
            return cls.from_urdf(name)
        return cls.read(Path(chain)) if Path(chain).suffix in (".yaml", ".yml") else cls.shipped(chain)

    def narrowed(self, ranges_deg: Array) -> ChainDescription:
        """Return the same arm with each joint's range narrowed to ``ranges_deg`` (n, 2), lower and upper."""
        joints = [
            joint.model_copy(
                update={
                    "lower_deg": max(joint.lower_deg, float(lower)),
                    "upper_deg": min(joint.upper_deg, float(upper)),
                }
            )
            for joint, (lower, upper) in zip(self.joints, ranges_deg, strict=True)
        ]
        return self.model_copy(update={"joints": tuple(joints)})


class SerialChain:
    """Kinematics of a described arm with one tool.

    Args:
        description: the arm.
        tool: tool on the flange; without one the tool centre point is the flange.
        gravity_m_s2: (3,) along base axes, for ceiling- and wall-mounted arms.

    Attributes:
        description, tool: description of the arm and its tool.
        joint_names, lower, upper, speed, accel, torque: (n,) per joint, rad, rad, rad/s, rad/s2, N m.
    """

    def __init__(
        self, description: ChainDescription, tool: Tool | None = None, gravity_m_s2: Vector3 = GRAVITY_M_S2
    ) -> None:
        self.description = description
        joints = description.joints
        self.tool = tool = tool or Tool()
        self.joint_names = tuple(joint.name for joint in joints)
        self.lower = np.deg2rad([joint.lower_deg for joint in joints])
        self.upper = np.deg2rad([joint.upper_deg for joint in joints])
        self.speed = np.deg2rad([joint.speed_deg_s for joint in joints])
        self.accel = np.deg2rad([joint.accel_deg_s2 for joint in joints])
        self.torque = np.array([joint.torque_n_m for joint in joints])
        self._engine: PinocchioEngine | None = None
        self._axes = np.array([np.array(joint.axis) / np.linalg.norm(joint.axis) for joint in joints])
        # Rodrigues' formula, split to place all joints at once: T(q) = fixed + sin q * sine + (1 - cos q) * cosine.
        self._fixed = np.array([joint.pose() for joint in joints])
        skew = np.zeros((len(joints), 4, 4))
        skew[:, :3, :3] = [_skew(axis) for axis in self._axes]
        self._sine = self._fixed @ skew
        self._cosine = self._sine @ skew
        T_joint_flange = description.flange.pose()
        self._T_joint_tcp = T_joint_flange @ tool.pose()
        self._mass, self._com = _links(joints, T_joint_flange, tool)
        self._gravity = np.array(gravity_m_s2)

    def accelerate(self) -> bool:
        """Compute by pinocchio from now on, where it is installed; return whether it is. Takes a moment."""
        with suppress(ImportError):
            self._engine = self._engine or PinocchioEngine(
                self._fixed, self._axes, self._mass, self._com, self._T_joint_tcp, self._gravity
            )
        return self._engine is not None

    @property
    def joint_count(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def reach_m(self) -> float:
        """Distance from the base that the tool centre point never exceeds: the lengths of all links together."""
        links = np.linalg.norm(self._fixed[:, :3, 3], axis=1).sum()
        return float(links + np.linalg.norm(self._T_joint_tcp[:3, 3]))

    def forward(self, q: Array) -> Array:
        """Return the pose ``T_base_tcp`` (4, 4) at ``q`` (n,) rad. Raises GeometryError for a wrong shape or NaN."""
        if self._engine is not None and self._engine.accepts(q):
            return self._engine.forward(q)
        return self._place(q)[1]

    def link_poses(self, q: Array) -> Array:
        """Return the poses (n, 4, 4) of the joint frames in the base, after rotation. Raises GeometryError."""
        return self._place(q)[0]

    def jacobian(self, q: Array) -> Array:
        """Return the geometric Jacobian (6, n): [v, w] of the tool centre point along base axes per joint velocity."""
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return pose and Jacobian from one pass, for control loops."""
        if self._engine is not None and self._engine.accepts(q):
            return self._engine.forward_and_jacobian(q)
        T_base_joint, T_base_tcp = self._place(q)
        axes = self._axes_in_base(T_base_joint)
        J = np.empty((6, len(axes)))
        J[:3] = _cross(axes, T_base_tcp[:3, 3] - T_base_joint[:, :3, 3]).T
        J[3:] = axes.T
        return T_base_tcp, J

    def gravity_torques(self, q: Array) -> Array:
        """Return the motor torques (n,) N m that hold arm and tool still at ``q``."""
        if self._engine is not None and self._engine.accepts(q):
            return self._engine.gravity_torques(q)
        T_base_joint, _ = self._place(q)
        origins = T_base_joint[:, :3, 3]
        moments = self._mass[:, None] * (np.einsum("nij,nj->ni", T_base_joint[:, :3, :3], self._com) + origins)
        # Joint i carries every link from i outwards.
        carried_mass = np.cumsum(self._mass[::-1])[::-1]
        carried_moment = np.cumsum(moments[::-1], axis=0)[::-1]
        lever = carried_moment - carried_mass[:, None] * origins
        held: Array = np.einsum("ni,ni->n", self._axes_in_base(T_base_joint), _cross(lever, -self._gravity[None, :]))
        return held

    def _axes_in_base(self, T_base_joint: Array) -> Array:
        axes: Array = np.matmul(T_base_joint[:, :3, :3], self._axes[:, :, None])[:, :, 0]
        return axes

    def _place(self, q: Array) -> tuple[Array, Array]:
        q = np.asarray(q, dtype=np.float64)
        if q.shape != (self.joint_count,):
            raise GeometryError("SerialChain", "q", f"has shape {q.shape}, not ({self.joint_count},)")
        if not np.isfinite(q).all():
            raise GeometryError("SerialChain", "q", "is not finite")
        T_base_joint = (
            self._fixed + np.sin(q)[:, None, None] * self._sine + (1.0 - np.cos(q))[:, None, None] * self._cosine
        )
        for i in range(1, len(q)):
            T_base_joint[i] = T_base_joint[i - 1] @ T_base_joint[i]
        return T_base_joint, T_base_joint[-1] @ self._T_joint_tcp


@dataclass(frozen=True, slots=True)
class JointMotion:
    """Joint velocities for a twist, and the twist that they achieve.

    Attributes:
        dq: (n,) rad/s, within every limit.
        twist: (6,) achieved twist of the tool centre point, along base axes.
        scale: fraction of the motion left by the limits.
        smallest_singular_value: of the Jacobian with its angular rows multiplied by the characteristic length, m.
        adjustments: limits that made ``twist`` differ from the requested one.
    """

    dq: Array
    twist: Array
    scale: float
    smallest_singular_value: float
    adjustments: tuple[Adjustment, ...]


class DifferentialIk:
    """Convert twists of the tool centre point into joint velocities, by damped least squares.

    Each direction is damped by its own singular value (numerical filtering, Maciejewski & Klein 1988), so directions
    far from singular are followed exactly. When a joint of a redundant arm reaches a limit, it moves at that limit and
    the other joints compensate (saturation in the null space, Flacco et al. 2012); what still exceeds a limit slows the
    whole motion, so that the tool keeps its direction instead of leaving its path.

    Args:
        chain: kinematic chain of the arm.
        settings: handling of limits.
    """

    def __init__(self, chain: SerialChain, settings: IkSettings | None = None) -> None:
        self.chain = chain
        self.settings = settings or IkSettings()
        self._weights = np.array([1.0, 1.0, 1.0, *[self.settings.characteristic_length_m] * 3])

    def solve(self, q: Array, twist: Array) -> JointMotion:
        """Return the joint velocities at ``q`` (n,) rad for ``twist`` (6,) [v, w] along base axes.

        Raises:
            GeometryError: an argument has the wrong shape or is not finite.
        """
        twist = np.asarray(twist, dtype=np.float64)
        if twist.shape != (6,) or not np.isfinite(twist).all():
            raise GeometryError("DifferentialIk.solve", "twist", "is not six finite numbers")
        return self.at(q).motion(twist)

    def at(self, q: Array) -> LocalIk:
        """Return a solver for several twists at one ``q`` (n,) rad. Raises GeometryError for a wrong shape or NaN."""
        return LocalIk(self, q, self._weights)


class LocalIk:
    """Differential inverse kinematics at one joint configuration.

    Args:
        ik: arm and settings.
        q: (n,) rad.
        weights: (6,) weights of a twist's components.
    """

    def __init__(self, ik: DifferentialIk, q: Array, weights: Array) -> None:
        self._chain = ik.chain
        self._settings = ik.settings
        self._q = q
        self._weights = weights
        self._J = self._weighted_jacobian(q)
        self._inverse, self._smallest = self._inverted(self._J)
        chain, margin_rad = ik.chain, ik.settings.limit_margin_rad
        self._bounds = speed_bounds(q, chain.lower, chain.upper, chain.speed, margin_rad)

    def acceleration_scale(self, step: Array, dt_s: float) -> tuple[float, tuple[Adjustment, ...]]:
        """Return the fraction of the twist change ``step`` (6,) in ``dt_s`` within all joint accelerations, and why."""
        ddq = self._inverse @ (self._weights * step) / dt_s
        return within_acceleration(ddq, self._chain.accel, self._chain.joint_names)

    def motion(self, twist: Array) -> JointMotion:
        """Return the joint velocities for ``twist`` (6,), within every limit."""
        dq, scale, adjustments = self.limited(twist)
        return JointMotion(dq, (self._J @ dq) / self._weights, scale, self._smallest, adjustments)

    def limited(self, twist: Array) -> tuple[Array, float, tuple[Adjustment, ...]]:
        """Return joint velocities (n,) for ``twist`` (6,) within every limit, the achieved fraction of it, and why."""
        chain, settings = self._chain, self._settings
        lowest, highest = self._bounds
        dq = self._inverse @ (self._weights * twist)
        if settings.uses_null_space and len(dq) > 6:
            dq = self._saturated(dq, self._weights * twist, lowest, highest)
        scale, adjustments = within_bounds(dq, lowest, highest, chain.joint_names)
        # Rounding must not exceed a limit either.
        dq = np.clip(dq * scale, lowest, highest)
        if self._smallest < settings.singular_value_m and dq.any():
            left, why = self._off_singularity(dq)
            scale, dq, adjustments = scale * left, dq * left, adjustments + why
        return dq, scale, adjustments

    def _weighted_jacobian(self, q: Array) -> Array:
        J = self._chain.jacobian(q)
        J *= self._weights[:, None]
        return J

    def _inverted(self, J: Array) -> tuple[Array, float]:
        """Return the damped inverse (n, 6) of ``J`` (6, n) and its smallest singular value."""
        settings = self._settings
        U, s, Vt = np.linalg.svd(J, full_matrices=False)
        short = np.maximum(1.0 - (s / settings.singular_value_m) ** 2, 0.0)
        gain = s / np.maximum(s**2 + settings.damping_m**2 * short, np.finfo(np.float64).tiny)
        return (Vt.T * gain) @ U.T, float(s[-1])

    def _saturated(self, dq: Array, wanted: Array, lowest: Array, highest: Array) -> Array:
        free = np.ones(len(dq), dtype=bool)
        while np.count_nonzero(free) > 6:
            excess = np.where(free, np.maximum(dq - highest, lowest - dq), 0.0)
            worst = int(np.argmax(excess))
            if excess[worst] <= 0.0:
                break
            dq[worst] = np.clip(dq[worst], lowest[worst], highest[worst])
            free[worst] = False
            dq[free] = self._inverted(self._J[:, free])[0] @ (wanted - self._J[:, ~free] @ dq[~free])
        return dq

    def _off_singularity(self, dq: Array) -> tuple[float, tuple[Adjustment, ...]]:
        step_s = 1e-5 / float(np.abs(dq).max())
        ahead = np.linalg.svd(self._weighted_jacobian(self._q + step_s * dq), compute_uv=False)[-1]
        closing_m_s = (self._smallest - float(ahead)) / step_s
        fastest = float(np.max(np.abs(dq) / self._chain.speed))
        return off_singularity(self._smallest, closing_m_s, fastest, self._settings)


def _links(joints: tuple[Joint, ...], T_joint_flange: Array, tool: Tool) -> tuple[Array, Array]:
    """Return masses (n,) kg and centres of mass (n, 3) m in joint frames; the tool is part of the last link."""
    mass = np.array([joint.mass_kg for joint in joints])
    com = np.array([joint.com_mm for joint in joints]) * 1e-3
    tool_com = T_joint_flange[:3, :3] @ (np.array(tool.com_mm) * 1e-3) + T_joint_flange[:3, 3]
    if total := mass[-1] + tool.mass_kg:
        com[-1] = (mass[-1] * com[-1] + tool.mass_kg * tool_com) / total
    mass[-1] = total
    return mass, com


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _rotation(axis: Array, angle: float) -> Array:
    K = _skew(axis)
    R: Array = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
    return R


def _cross(a: Array, b: Array) -> Array:
    """Return row-wise cross products (n, 3); np.cross takes five times as long on arrays this small."""
    product: Array = a[:, _YZX] * b[:, _ZXY] - a[:, _ZXY] * b[:, _YZX]
    return product


_YZX = np.array([1, 2, 0])
_ZXY = np.array([2, 0, 1])
