"""Kinematics of serial arms whose makers give none: forward, differential inverse, and the torques of gravity.

A chain is described in YAML (``drivers/chains``): per joint its placement in the link before it, its axis, its limits,
and the mass and centre of mass of the link that it moves. All joints turn (no slides). Numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.commands import Adjustment
from drivers.errors import ConfigError
from geometry.errors import GeometryError
from geometry.types import Array

Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]

GRAVITY_M_S2 = (0.0, 0.0, -9.80665)
"""Standard gravity (ISO 80000-3) along the axes of a base that stands upright."""


class _Description(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Placement(_Description):
    """Pose of a frame in the one before it; the angles are extrinsic xyz, R = Rz Ry Rx."""

    origin_mm: Vector3 = (0.0, 0.0, 0.0)
    rotation_deg: Vector3 = (0.0, 0.0, 0.0)

    def pose(self) -> Array:
        """As a (4, 4) pose."""
        T = np.eye(4)
        for axis, angle_deg in zip(np.eye(3), self.rotation_deg, strict=True):
            T[:3, :3] = _rotation(axis, np.deg2rad(angle_deg)) @ T[:3, :3]
        T[:3, 3] = np.array(self.origin_mm) * 1e-3
        return T


class Joint(Placement):
    """A revolute joint and the link that it moves.

    The joint frame sits at ``origin_mm`` and ``rotation_deg`` in the link before it when the joint is at zero;
    ``axis`` and ``com_mm`` are given in the joint frame.
    """

    name: str
    axis: Vector3 = (0.0, 0.0, 1.0)
    lower_deg: float
    upper_deg: float
    speed_deg_s: Positive
    torque_n_m: Positive
    mass_kg: NotNegative = 0.0
    com_mm: Vector3 = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.lower_deg >= self.upper_deg:
            raise ValueError(f"joint {self.name!r}: lower_deg {self.lower_deg} is not below upper_deg {self.upper_deg}")
        if not np.linalg.norm(self.axis) > 0.0:
            raise ValueError(f"joint {self.name!r}: axis has no length")
        return self


class Tool(Placement):
    """What is screwed to the flange: pose of the tool centre point, and mass and centre of mass in the flange frame."""

    mass_kg: NotNegative = 0.0
    com_mm: Vector3 = (0.0, 0.0, 0.0)


class ChainDescription(_Description):
    """A serial arm, base to flange."""

    name: str
    joints: tuple[Joint, ...] = Field(min_length=1)
    flange: Placement = Placement()

    @classmethod
    def read(cls, path: Path) -> ChainDescription:
        """Read a YAML file. Raises ConfigError with the file and what is wrong in it."""
        try:
            return cls.model_validate(yaml.safe_load(path.read_text()))
        except (OSError, yaml.YAMLError, ValidationError) as error:
            raise ConfigError(f"is no chain description: {error}", file=str(path)) from None

    @classmethod
    def shipped(cls, name: str) -> ChainDescription:
        """One of the descriptions that come with touchcell. Raises ConfigError for an unknown name."""
        folder = Path(str(files("drivers") / "chains"))
        known = sorted(path.stem for path in folder.glob("*.yaml"))
        if name not in known:
            raise ConfigError(f"unknown chain {name!r}", key="chain", value=name, hint=f"known: {', '.join(known)}")
        return cls.read(folder / f"{name}.yaml")


class SerialChain:
    """Kinematics of one described arm with one tool.

    Args:
        description: the arm.
        tool: what its flange carries; without one the tool centre point is the flange.
        gravity_m_s2: (3,) along base axes, for arms that hang or stand on a wall.

    Attributes:
        joint_names, lower, upper, speed, torque: (n,) per joint, rad, rad, rad/s, N m.
    """

    def __init__(
        self, description: ChainDescription, tool: Tool | None = None, gravity_m_s2: Vector3 = GRAVITY_M_S2
    ) -> None:
        joints = description.joints
        tool = tool or Tool()
        self.joint_names = tuple(joint.name for joint in joints)
        self.lower = np.deg2rad([joint.lower_deg for joint in joints])
        self.upper = np.deg2rad([joint.upper_deg for joint in joints])
        self.speed = np.deg2rad([joint.speed_deg_s for joint in joints])
        self.torque = np.array([joint.torque_n_m for joint in joints])
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

    @property
    def joint_count(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    def forward(self, q: Array) -> Array:
        """Pose ``T_base_tcp`` (4, 4) at joint angles ``q`` (n,) rad. Raises GeometryError for a wrong shape or NaN."""
        return self._place(q)[1]

    def jacobian(self, q: Array) -> Array:
        """Geometric Jacobian (6, n): [v, w] of the tool centre point along base axes per joint velocity."""
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Both at once, for control loops."""
        T_base_joint, T_base_tcp = self._place(q)
        axes = self._axes_in_base(T_base_joint)
        J = np.empty((6, len(axes)))
        J[:3] = _cross(axes, T_base_tcp[:3, 3] - T_base_joint[:, :3, 3]).T
        J[3:] = axes.T
        return T_base_tcp, J

    def gravity_torques(self, q: Array) -> Array:
        """Motor torques (n,) N m that hold the arm and its tool still at ``q``."""
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
    """Joint velocities for a twist, and how well they follow it.

    Attributes:
        dq: (n,) rad/s, within every limit.
        twist: (6,) what the tool centre point will really do, along base axes.
        smallest_singular_value: of the Jacobian with its angular rows times the characteristic length, m.
        adjustments: which limits made ``twist`` differ from what was asked for.
    """

    dq: Array
    twist: Array
    smallest_singular_value: float
    adjustments: tuple[Adjustment, ...]


@dataclass(frozen=True, slots=True)
class IkSettings:
    """How ``DifferentialIk`` treats limits.

    Attributes:
        characteristic_length_m: one radian weighs as much as this many metres; about half the arm's reach makes the
            singular values comparable.
        singular_value_m: directions with a smaller singular value are damped, and approached slowly.
        singular_floor_m: motion that would bring the smallest singular value below this is refused; leaving is free.
        damping_m: largest damping, reached at a singular value of zero; it bounds the joint speed per tool speed.
        singular_gain_hz: the distance to the floor shrinks by at most this fraction per second.
        limit_margin_rad: over this last stretch a joint's outward speed falls linearly to zero; inward it is free.
    """

    characteristic_length_m: float = 0.25
    singular_value_m: float = 0.04
    singular_floor_m: float = 0.02
    damping_m: float = 0.04
    singular_gain_hz: float = 10.0
    limit_margin_rad: float = np.deg2rad(5.0)


class DifferentialIk:
    """Twists of the tool centre point to joint velocities, by damped least squares.

    Each direction is damped by its own singular value (numerical filtering, after Maciejewski & Klein 1988), so that
    directions far from singular are followed exactly. A redundant arm moves a joint that meets a limit as fast as it
    may and makes up for it with the others (saturation in the null space, Flacco et al. 2012); what still exceeds a
    limit slows the whole motion, so that the tool keeps its direction instead of being pushed off its path.

    Args:
        chain: the arm.
        settings: treatment of limits.
    """

    def __init__(self, chain: SerialChain, settings: IkSettings | None = None) -> None:
        self._chain = chain
        self._settings = settings or IkSettings()
        self._weights = np.array([1.0, 1.0, 1.0, *[self._settings.characteristic_length_m] * 3])

    def solve(self, q: Array, twist: Array) -> JointMotion:
        """Joint velocities at ``q`` (n,) rad for ``twist`` (6,) [v, w] along base axes.

        Raises:
            GeometryError: an argument has the wrong shape or is not finite.
        """
        twist = np.asarray(twist, dtype=np.float64)
        if twist.shape != (6,) or not np.isfinite(twist).all():
            raise GeometryError("DifferentialIk.solve", "twist", "is not six finite numbers")
        J = self._weighted_jacobian(q)
        lowest, highest = self._speed_bounds(q)
        dq, smallest = self._saturated(J, self._weights * twist, lowest, highest)
        adjustments: list[Adjustment] = []
        dq = self._slow_to_bounds(dq, lowest, highest, adjustments)
        if smallest < self._settings.singular_value_m:
            dq = self._slow_to_singularity(q, dq, smallest, adjustments)
        return JointMotion(dq, (J @ dq) / self._weights, smallest, tuple(adjustments))

    def _weighted_jacobian(self, q: Array) -> Array:
        J = self._chain.jacobian(q)
        J *= self._weights[:, None]
        return J

    def _speed_bounds(self, q: Array) -> tuple[Array, Array]:
        """Slowest and fastest joint speeds allowed at ``q``; standing still always is."""
        chain = self._chain
        rate = chain.speed / self._settings.limit_margin_rad
        highest = np.minimum(np.maximum(rate * (chain.upper - q), 0.0), chain.speed)
        lowest = np.maximum(np.minimum(rate * (chain.lower - q), 0.0), -chain.speed)
        return lowest, highest

    def _saturated(self, J: Array, wanted: Array, lowest: Array, highest: Array) -> tuple[Array, float]:
        dq, smallest = self._damped(J, wanted)
        free = np.ones(len(dq), dtype=bool)
        while np.count_nonzero(free) > 6:
            excess = np.where(free, np.maximum(dq - highest, lowest - dq), 0.0)
            worst = int(np.argmax(excess))
            if excess[worst] <= 0.0:
                break
            dq[worst] = np.clip(dq[worst], lowest[worst], highest[worst])
            free[worst] = False
            dq[free] = self._damped(J[:, free], wanted - J[:, ~free] @ dq[~free])[0]
        return dq, smallest

    def _damped(self, J: Array, wanted: Array) -> tuple[Array, float]:
        settings = self._settings
        U, s, Vt = np.linalg.svd(J, full_matrices=False)
        short = np.maximum(1.0 - (s / settings.singular_value_m) ** 2, 0.0)
        gain = s / np.maximum(s**2 + settings.damping_m**2 * short, np.finfo(np.float64).tiny)
        return Vt.T @ (gain * (U.T @ wanted)), float(s[-1])

    def _slow_to_bounds(self, dq: Array, lowest: Array, highest: Array, adjustments: list[Adjustment]) -> Array:
        allowed = np.clip(dq, lowest, highest)
        # Rounding that points outwards at a limit must not stop the whole arm; the last clip takes care of it.
        over = np.abs(allowed - dq) > _NEGLIGIBLE
        if not over.any():
            return allowed
        scale = np.where(over, allowed / np.where(over, dq, 1.0), 1.0)
        worst = int(np.argmin(scale))
        name = self._chain.joint_names[worst]
        adjustments.append(Adjustment(f"joint {name}", float(dq[worst]), float(allowed[worst])))
        slowed: Array = np.clip(dq * scale[worst], lowest, highest)
        return slowed

    def _slow_to_singularity(self, q: Array, dq: Array, smallest: float, adjustments: list[Adjustment]) -> Array:
        settings = self._settings
        fastest = float(np.abs(dq).max())
        if fastest == 0.0:
            return dq
        step_s = 1e-5 / fastest
        ahead = np.linalg.svd(self._weighted_jacobian(q + step_s * dq), compute_uv=False)[-1]
        closing = (smallest - float(ahead)) / step_s
        allowed = settings.singular_gain_hz * max(smallest - settings.singular_floor_m, 0.0)
        if closing <= allowed + _NEGLIGIBLE:
            return dq
        adjustments.append(Adjustment("singularity", closing, allowed))
        return dq * (allowed / closing)


def _links(joints: tuple[Joint, ...], T_joint_flange: Array, tool: Tool) -> tuple[Array, Array]:
    """Masses (n,) kg and centres of mass (n, 3) m in joint frames, the tool counted with the last link."""
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
    """Row-wise cross products (n, 3); np.cross takes five times as long on arrays this small."""
    product: Array = a[:, _YZX] * b[:, _ZXY] - a[:, _ZXY] * b[:, _YZX]
    return product


_YZX = np.array([1, 2, 0])
_ZXY = np.array([2, 0, 1])
_NEGLIGIBLE = 1e-6
